(() => {
  "use strict";
  const isNarrow = matchMedia("(max-width: 40rem)").matches;
  const AT_ONCE = isNarrow ? 20 : 100;
  const section = document.getElementById("queries");
  const { outcomes, metres, rows } = JSON.parse(document.getElementById("results").textContent);
  const form = section.querySelector("form"), body = section.querySelector("tbody");
  const more = section.querySelector(".more"), output = section.querySelector("output");
  const dash = "\u2013";
  // Of each column its title, the place of its value in a row, and the value in words.
  const columns = [
    ["query", 0, (value) => value],
    ["outcome", 1, (value) => ["\u2717 ", "", "\u2713 "][value] + outcomes[value]],
    ["first right", 2, (value) => value ?? dash],
    ["first retrieval", 3, (value) => value],
    ["similarity", 4, (value) => value.toFixed(3)],
    ["metres", 5, (value) => (value === null ? dash : Math.round(value).toLocaleString("en"))],
  ].slice(0, metres ? 6 : 5);
  const names = rows.map((row) => `${row[0]}\n${row[3]}`.toLowerCase());
  let key = null, ascending = true, found = [], shown = AT_ONCE;

  function compare(a, b) {
    const x = rows[a], y = rows[b];
    if (key === null) return x[1] - y[1] || y[4] - x[4] || a - b;
    const [p, q] = [x[key], y[key]];
    // Rows without a value stand last, whichever way the others stand.
    if (p === null || q === null) return (p === null) - (q === null) || a - b;
    return (p < q ? -1 : p > q ? 1 : 0) * (ascending ? 1 : -1) || a - b;
  }

  function draw(from) {
    for (const number of found.slice(from, shown)) {
      const line = document.createElement("tr");
      for (const [title, place, words] of columns) {
        const cell = line.appendChild(document.createElement("td"));
        cell.textContent = words(rows[number][place]);
        cell.dataset.label = title;
      }
      line.className = ["wrong", "", "right"][rows[number][1]];
      body.append(line);
    }
    const count = Math.min(shown, found.length).toLocaleString("en");
    output.textContent = `${count} of ${found.length.toLocaleString("en")} shown`;
    more.hidden = shown >= found.length;
    more.textContent = `Show ${Math.min(AT_ONCE, found.length - shown)} more`;
  }

  function update() {
    const text = form.elements.text.value.trim().toLowerCase(), outcome = form.elements.outcome.value;
    found = [...rows.keys()].filter(
      (n) => (outcome === "" || rows[n][1] === Number(outcome)) && names[n].includes(text)
    );
    found.sort(compare);
    shown = AT_ONCE;
    body.replaceChildren();
    draw(0);
  }

  const heads = columns.map(([title, place]) => {
    const head = document.createElement("th"), button = document.createElement("button");
    head.scope = "col";
    button.type = "button";
    button.textContent = title;
    button.addEventListener("click", () => {
      ascending = key === place ? !ascending : place !== 4;
      key = place;
      for (const other of heads) other.removeAttribute("aria-sort");
      head.setAttribute("aria-sort", ascending ? "ascending" : "descending");
      update();
    });
    head.append(button);
    return head;
  });
  section.querySelector("thead tr").append(...heads);
  more.addEventListener("click", () => {
    shown += AT_ONCE;
    draw(shown - AT_ONCE);
  });
  let waiting;
  form.addEventListener("input", () => {
    clearTimeout(waiting);
    waiting = setTimeout(update, 100);
  });
  form.addEventListener("submit", (event) => event.preventDefault());
  update();
})();

# Sourced by the other scripts from the repository root: creates .venv once, installs the package
# into it with the given extras, and activates it. PYTHON selects the interpreter.
extras="$1"
if [ ! -x .venv/bin/python ]; then
  "${PYTHON:-python3}" -m venv .venv
fi
# shellcheck disable=SC1091
source .venv/bin/activate
stamp=".venv/installed${extras}"
if [ ! -f "$stamp" ] || [ pyproject.toml -nt "$stamp" ]; then
  echo "Installing crisalad-jax${extras} into .venv; the first time takes a few minutes." >&2
  # Torch comes first, separately, because its exact version may be available as a smaller CPU build.
  # Modules are compiled at first import; most are never imported.
  install=(python -m pip install --quiet --no-compile)
  case "$extras" in *dev*) "${install[@]}" "$(grep -o 'torch==[0-9.]*' pyproject.toml)" ;; esac
  "${install[@]}" --editable ".${extras}"
  touch "$stamp"
fi

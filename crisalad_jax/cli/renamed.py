"""Flags of earlier versions, which are replaced with a note."""

import re
from collections.abc import Callable, Mapping, Sequence

from crisalad_jax.config.aliases import (
    AGGREGATORS,
    CLASSES,
    LOSSES,
    NORMALISATION,
    PROBLEM,
    REMAT,
)

_PROBLEM = "|".join(name.replace("_", "-") for name in PROBLEM)
_CLASSES = "|".join(name.replace("_", "-") for name in CLASSES)
_RENAMED: Sequence[tuple[str, str]] = (
    (rf"--model\.salad\.sinkhorn\.({_PROBLEM})", r"--model.aggregator.\1"),
    (r"--model\.salad\.sinkhorn\.method", "--model.aggregator.sinkhorn.step"),
    (r"--model\.salad\.sinkhorn\.relaxation", "--model.aggregator.sinkhorn.step.relaxation"),
    (r"--model\.salad\.sinkhorn\.must-converge", "--model.aggregator.sinkhorn.throw"),
    (r"--model\.salad\.sinkhorn\.anderson", "--model.aggregator.sinkhorn.anderson-memory"),
    (rf"--model\.({'|'.join(AGGREGATORS)})\.(.+)", r"--model.aggregator.\2"),
    (r"--model\.encoder\.(.+)", r"--model.cross-image.\1"),
    (r"--model\.keeps", "--model.remat"),
    (r"--model\.normalisation", "--model.preprocessing.normalisation"),
    (r"--model\.backbone\.position-start", "--model.backbone.position-init"),
    (r"--model\.backbone\.layer-scale-start", "--model.backbone.layer-scale-init"),
    (r"--loss\.epsilon", "--loss.miner-margin"),
    (r"--(no-)?loss\.library-quirk", r"--\1loss.match-pml-zero"),
    (r"--loss\.large-margin-cosine\.classes", "--loss.kind.classes.kind"),
    (rf"--loss\.large-margin-cosine\.({_CLASSES})", r"--loss.kind.classes.\1"),
    (rf"--loss\.({'|'.join(LOSSES)})\.(.+)", r"--loss.kind.\2"),
    (r"--optimiser\.final-fraction", "--optimiser.end-lr-fraction"),
    (r"--optimiser\.drop-epochs", "--optimiser.step-epochs"),
    (r"--optimiser\.drop-factor", "--optimiser.step-gamma"),
    (r"--trains", "--trainable"),
    (r"--augment", "--augmentation"),
    (r"--(rand|light)-augment\.(.+)", r"--augmentation.\2"),
    (r"--(no-)?split-state", r"--\1shard-state"),
    (r"--workers", "--num-workers"),
    (r"--coordinator", "--coordinator-address"),
    (r"--processes", "--num-processes"),
    (r"--process", "--process-id"),
)

_VALUES: Mapping[str, Mapping[str, str]] = {
    "--model.remat": REMAT,
    "--model.preprocessing.normalisation": NORMALISATION,
}
"""Old values of flags, and today's."""


def today(arguments: Sequence[str], tell: Callable[[str], None]) -> list[str]:
    """Replace old names of flags by today's; `tell` is given a line for each old one."""
    updated = list(arguments)
    for position, argument in enumerate(updated):
        flag, equals, value = argument.partition("=")
        if not flag.startswith("--"):
            continue
        old = flag.replace("_", "-")
        for pattern, new in _RENAMED:
            match = re.fullmatch(pattern, old)
            if match is None:
                continue
            name = match.expand(new)
            tell(f"{old} is {name} now")
            values = _VALUES.get(name, {})
            updated[position] = f"{name}{equals}{values.get(value, value)}"
            if not equals and position + 1 < len(updated):
                updated[position + 1] = values.get(updated[position + 1], updated[position + 1])
            break
    return updated

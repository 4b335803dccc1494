"""``python -m tools.battery fuzz|faults|determinism|mutation|soak``."""

from __future__ import annotations

import os
import sys

# One thread in every numerical library: children are forked, and threads do not survive that.
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

from pathlib import Path  # noqa: E402

import click  # noqa: E402

_FILE = click.Path(path_type=Path, dir_okay=False)


@click.group(context_settings={"help_option_names": ["-h", "--help"]})
def main() -> None:
    """Try to break gcar; counts are printed, and a finding ends with exit code 1."""


@main.command()
@click.option("--kind", "kinds", multiple=True, help="Only this kind; may be repeated.")
@click.option("--share", default=1.0, show_default=True, help="Share of the full counts.")
@click.option("--seed", default=0, show_default=True)
@click.option("--state", type=_FILE, help="Notes what is done; the same call goes on there.")
def fuzz(kinds: tuple[str, ...], share: float, seed: int, state: Path | None) -> None:
    """Damaged pictures, geometries, models, runs, checkpoints, requests, command lines.

    Example: python -m tools.battery fuzz --state runs/fuzz.json
    """
    from tools.battery.fuzz import KINDS
    from tools.battery.fuzz import fuzz as work

    unknown = set(kinds) - set(KINDS)
    if unknown:
        raise click.UsageError(f"unknown kind {sorted(unknown)[0]!r}; known: {', '.join(KINDS)}")
    sys.exit(min(work(kinds or tuple(KINDS), share, seed, state), 1))


if __name__ == "__main__":
    main()

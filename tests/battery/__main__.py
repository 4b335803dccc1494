"""``python -m tests.battery fuzz|faults|determinism|mutation|soak``."""

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

    Example: python -m tests.battery fuzz --state runs/fuzz.json
    """
    from tests.battery.fuzz import KINDS
    from tests.battery.fuzz import fuzz as work

    unknown = set(kinds) - set(KINDS)
    if unknown:
        raise click.UsageError(f"unknown kind {sorted(unknown)[0]!r}; known: {', '.join(KINDS)}")
    sys.exit(min(work(kinds or tuple(KINDS), share, seed, state), 1))


@main.command()
@click.option("--kills", default=50, show_default=True)
@click.option("--signals", default=20, show_default=True)
@click.option("--seed", default=0, show_default=True)
def faults(kills: int, signals: int, seed: int) -> None:
    """Kills, signals, a full disk, a read-only place: nothing half-written.

    Example: python -m tests.battery faults
    """
    from tests.battery.faults import faults as work

    sys.exit(min(work(kills, signals, seed), 1))


@main.command()
@click.option("--repeats", default=20, show_default=True, help="Cold and warm, per thread count.")
@click.option("--threads", default="1,2", show_default=True)
@click.option("--hash-seeds", default=5, show_default=True)
@click.option("--case", type=click.Choice(["tiny", "demo"]), default="tiny", show_default=True)
def determinism(repeats: int, threads: str, hash_seeds: int, case: str) -> None:
    """Check for same bytes: cold, warm, any hash seed; 1e-6 between numbers of threads.

    Example: python -m tests.battery determinism --case demo
    """
    from tests.battery.determinism import determinism as work

    counts = tuple(int(word) for word in threads.split(","))
    sys.exit(min(work(repeats, counts, hash_seeds, case), 1))


@main.command()
@click.option("--count", default=2000, show_default=True)
@click.option("--seed", default=0, show_default=True)
def soak(count: int, seed: int) -> None:
    """Good and bad cases in one warm process: memory, threads, files.

    Example: python -m tests.battery soak
    """
    from tests.battery.soak import soak as work

    sys.exit(min(work(count, seed), 1))


@main.command()
@click.option("--only", multiple=True, help="Only this bug; may be repeated.")
def mutation(only: tuple[str, ...]) -> None:
    """Deliberate bugs, each of which named tests must catch.

    Example: python -m tests.battery mutation
    """
    from tests.battery.mutation import mutation as work

    sys.exit(min(work(only), 1))


if __name__ == "__main__":
    main()

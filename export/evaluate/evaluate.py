"""Evaluate methods over label volumes: simulate, reconstruct, measure, tabulate, draw.

One job is one case, one number of views and one method; its row is written as soon as it
is done, so an interrupted evaluation goes on where it stopped. A label that no case can be made of
has rows with the reason. Every row remembers the
settings and the label file it was made with: rows of others are made anew, or refused, and never
mixed in unsaid.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import logging
from collections.abc import Callable, Generator, Mapping, Sequence
from pathlib import Path
from typing import Any

from gcar_deploy.errors import UsageError
from gcar_deploy.files import is_free
from gcar_deploy.geometry.fields import LEAST_VIEWS, MOST_VIEWS
from gcar_export.evaluate import paper_tables, peers, tables
from gcar_export.evaluate.engines import ENGINES, Outcome, run_in_processes, run_on_dask
from gcar_export.evaluate.jobs import NO_CASE, Job, case_name, row_path, write_done
from gcar_export.methods.own_models import sha256
from gcar_export.methods.settings import METHODS, RUNTIME_ROWS, MethodSettings
from gcar_export.methods.solve import check_models
from gcar_export.scenes.label_files import label_files
from gcar_export.scenes.labels import case_stem
from gcar_export.scenes.protocols import COMMON, PROTOCOLS
from gcar_export.scenes.thin_protocol import THIN, thin_names

LOGGER = logging.getLogger(__name__)
#: protocols that one word asks for
GROUPS: Mapping[str, tuple[str, ...]] = {"common": tuple(COMMON), "thin": tuple(THIN)}
#: what to do with rows that were made with other settings or label files.
CHANGED = ("redo", "keep", "refuse")
#: what a row is tied to, in words
_TIED = ("settings", "label files")
#: what a row's file is named by
_KEYS = ("protocol", "case", "views", "method")
#: what a row has in every version
_NEEDED = {*_KEYS, "dataset", "status", "measures", "stages"}
OnProgress = Callable[[int, int, str], None]


@dataclasses.dataclass(frozen=True, kw_only=True)
class EvaluateOptions:
    """What to evaluate.

    Attributes
    ----------
    data : folder with label volumes (``imagecas/``, ``asoca/``, or the files themselves; a
        folder that holds them in ``data/`` is taken as well); None for ``thin``, whose trees are
        generated
    out : folder for rows, tables and pictures; may hold an interrupted evaluation
    protocol : one of ``PROTOCOLS`` or ``GROUPS``
    methods : names from ``METHODS``
    views : numbers of views
    jobs : processes
    cases : only cases with these names; all if empty
    reference : method the others are tested against; the first of ``methods`` if None
    engine : one of ``ENGINES``
    scheduler : address of the Dask scheduler
    changed : one of ``CHANGED``
    redo : methods whose rows are made anew in any case
    settings : MethodSettings
    """

    data: Path | None
    out: Path
    protocol: str
    methods: tuple[str, ...]
    views: tuple[int, ...] = (2,)
    jobs: int = 1
    cases: tuple[str, ...] = ()
    reference: str | None = None
    engine: str = "processes"
    scheduler: str | None = None
    changed: str = "redo"
    redo: tuple[str, ...] = ()
    settings: MethodSettings = dataclasses.field(default_factory=MethodSettings)

    def __post_init__(self) -> None:
        if self.protocol not in (*PROTOCOLS, *GROUPS):
            known = ", ".join((*PROTOCOLS, *GROUPS))
            raise UsageError(f"protocol {self.protocol!r} is none of {known}")
        for key in ("methods", "views", "cases"):
            given = getattr(self, key)
            twice = [value for k, value in enumerate(given) if value in given[:k]]
            if twice:
                raise UsageError(f"{key}: {twice[0]} is named twice")
        unknown = [m for m in self.methods if m not in METHODS]
        if unknown or not self.methods:
            raise UsageError(f"unknown method {unknown}; there are {', '.join(METHODS)}")
        if not self.views or any(not LEAST_VIEWS <= n <= MOST_VIEWS for n in self.views):
            taken = f"numbers from {LEAST_VIEWS} to {MOST_VIEWS}"
            raise UsageError(f"views = {self.views!r} must be {taken}")
        if self.jobs < 1:
            raise UsageError(f"jobs = {self.jobs} must be at least 1")
        if self.reference is not None and self.reference not in self.methods:
            raise UsageError(f"reference {self.reference!r} is not among the methods")
        if self.engine not in ENGINES:
            raise UsageError(f"engine {self.engine!r} is none of {', '.join(ENGINES)}")
        if self.changed not in CHANGED:
            raise UsageError(f"changed = {self.changed!r} is none of {', '.join(CHANGED)}")
        if set(self.redo) - set(self.methods):
            raise UsageError(f"redo = {', '.join(self.redo)}: not all are among the methods")

    @property
    def protocols(self) -> tuple[str, ...]:
        """The protocols that ``protocol`` asks for."""
        return GROUPS.get(self.protocol, (self.protocol,))


def find_labels(data: Path, cases: Sequence[str] = ()) -> list[Path]:
    """Label volumes of a folder, as ``label_files`` finds them, of the cases that are asked for.

    Parameters
    ----------
    data : folder
    cases : only those with these names; all if empty

    Raises
    ------
    UsageError
        There are none, a case is not among them, or two files have the name of one case.
    """
    return _chosen(label_files(data, arrays=True), cases, data)


def evaluate(
    options: EvaluateOptions, on_progress: OnProgress | None = None
) -> list[dict[str, Any]]:
    """Run what is missing, write the tables, and return all rows.

    Parameters
    ----------
    options : EvaluateOptions
    on_progress : called with (done, total, text) after each row

    Raises
    ------
    UsageError
        No label volume, or none that a case can be made of; rows of other settings or label files
        and ``changed`` is ``refuse``; no cluster; ``out`` holds something else.
    ModelError
        A method's model is missing.
    """
    _check_place(options.out)
    generated = options.protocol == "thin"
    if generated:
        known = thin_names()
        labels = _chosen(known, options.cases, f"{known[0].name} .. {known[-1].name}")
    else:
        labels = find_labels(_given(options.data), options.cases)
    check_models(options.methods, options.settings)
    _check_own(options)
    digests = {method: options.settings.digest(method) for method in options.methods}
    models = {m: options.settings.own_models(m).said() for m in options.methods}
    data = {label: None if generated else sha256(label) for label in labels}
    jobs = [
        Job(
            label=label, protocol=protocol, method=method, views=views, digest=digests[method],
            data=data[label], models=models[method],
        )
        for protocol in options.protocols
        for label in labels
        for views in options.views
        for method in options.methods
    ]  # fmt: skip
    missing = _missing(jobs, options)
    done = len(jobs) - len(missing)
    works = done > 0
    if works:
        _make_folders(options)
    if on_progress is not None and done:
        on_progress(done, len(jobs), f"{done} rows kept")
    held: list[Outcome] = []
    # Closed at once, also by an interrupt: workers must not outlive the loop.
    with contextlib.closing(_outcomes(missing, options)) as outcomes:
        for job, outcome in outcomes:
            # Nothing is left behind where no case works.
            held.append((job, outcome))
            if not works and outcome.row["status"] != NO_CASE:
                works = True
                _make_folders(options)
            while works and held:
                write_done(options.out, *held.pop(0))
            done += 1
            if on_progress is not None:
                on_progress(done, len(jobs), job.name)
    rows = [o.row for _, o in held] or [_read(row_path(options.out, job)) for job in jobs]
    lost = without_case(rows)
    if len(lost) == len(labels):
        raise UsageError(f"no case can be made: {next(iter(lost.values()))}")
    write_tables(rows, options.out, options.reference or options.methods[0])
    return rows


def _check_place(out: Path) -> None:
    """Refuse a folder that holds something, and no evaluation: its files would be replaced.

    Raises
    ------
    UsageError
    """
    told = any((out / name).is_file() for name in ("settings.json", "cases.csv"))
    ours = told and (out / "rows").is_dir()
    # A run that was killed at once may have made no more than these.
    if not ours and not is_free(out, ("rows", "sides")):
        raise UsageError(f"{out} exists and holds no evaluation; choose another folder")


def _check_own(options: EvaluateOptions) -> None:
    """Refuse a model of the user's own that no row of these would ask.

    Raises
    ------
    UsageError
    """
    own, methods = options.settings.own, ", ".join(options.methods)
    asked = [options.settings.own_models(method) for method in options.methods]
    if own.predictor and not any(one.predictor for one in asked):
        raise UsageError(f"model {own.predictor} is asked by none of the methods {methods}")
    greys = any(RUNTIME_ROWS[m].grey_masks for m in options.methods if m in RUNTIME_ROWS)
    if own.segmenter and not (any(one.segmenter for one in asked) and (
        "raw" in options.protocols or greys
    )):  # fmt: skip
        raise UsageError(
            f"segmenter-model {own.segmenter} has nothing to do: protocol {options.protocol} with "
            f"{methods} shows no raw pictures in which a network finds vessels; take protocol raw"
        )


def beside(options: EvaluateOptions, rows: Sequence[Mapping[str, Any]]) -> str:
    """Say which finished rows in ``options.out`` are not among ``rows``; empty where all are."""
    shown = {"-".join(str(row[key]) for key in _KEYS) for row in rows}
    others, count = [], 0
    for path in (options.out / "rows").glob("*.json"):
        if path.stem not in shown:
            count += 1
            with contextlib.suppress(ValueError):
                others.append(_read(path))
    if not count:
        return ""
    new = {k: sorted({str(r[k]) for r in others} - {str(r[k]) for r in rows}) for k in _KEYS}
    told = "; ".join(f"{key} {', '.join(names)}" for key, names in new.items() if names)
    return (
        f"{count} finished rows in {options.out / 'rows'} are not in these tables"
        f"{told and f' ({told})'}: name all that belong together, finished rows are kept"
    )


def without_case(rows: Sequence[Mapping[str, Any]]) -> dict[str, str]:
    """Return the cases that could not be made in any of their rows, each with the reason."""
    made = {row["case"] for row in rows if row["status"] != NO_CASE}
    return {row["case"]: row["sentence"] for row in rows if row["case"] not in made}


def write_tables(rows: Sequence[dict[str, Any]], out: Path, reference: str) -> None:
    """Write ``cases.csv``, ``summary.json``, ``wilcoxon.json`` and ``tables.md``."""
    (out / "cases.csv").write_text(tables.case_rows_csv(rows))
    write_summaries(rows, out, reference)


def write_summaries(rows: Sequence[dict[str, Any]], out: Path, reference: str) -> None:
    """Write what follows from ``cases.csv``: the summary, the tests, the tables."""
    summary = json.dumps(tables.summarise(rows), indent=1, allow_nan=False)
    (out / "summary.json").write_text(summary)
    tests = json.dumps(tables.paired_tests(rows, reference), indent=1, allow_nan=False)
    (out / "wilcoxon.json").write_text(tests)
    text = [tables.markdown(rows, reference), tables.over_views(rows)]
    text += [paper_tables.layout(rows, reference), peers.beside_peers(rows)]
    short = tables.not_first(rows, reference) + tables.worse_with_views(rows, reference)
    text.append(f"Where {reference} is not first with p < 0.05:\n")
    text += [f"- {sentence}" for sentence in short] or ["- nowhere"]
    (out / "tables.md").write_text("\n".join(part for part in text if part) + "\n")


def _missing(jobs: Sequence[Job], options: EvaluateOptions) -> list[Job]:
    """Jobs without a row, and those whose row is out of date, which is said aloud."""
    missing, changed, others = [], [], set()
    for job in jobs:
        path = row_path(options.out, job)
        if not path.exists() or job.method in options.redo:
            missing.append(job)
            continue
        try:
            row = _read(path)
        except ValueError:
            LOGGER.warning("%s is damaged: made again", path)
            missing.append(job)
            continue
        same = (row.get("settings") == job.digest, row.get("label_sha256") == job.data)
        if not all(same):
            changed.append(job)
            others |= {what for what, equal in zip(_TIED, same, strict=True) if not equal}
    if not changed:
        return missing
    methods = ", ".join(dict.fromkeys(job.method for job in changed))
    said = (
        f"{len(changed)} rows of {methods} in {options.out} were made with other "
        f"{' and '.join(sorted(others, reverse=True))}"
    )
    if options.changed == "refuse":
        raise UsageError(f"{said}: take another --out, or --changed redo or keep")
    if options.changed == "keep":
        LOGGER.warning("%s: kept as they are", said)
        return missing
    LOGGER.warning("%s: made again", said)
    order = {job: k for k, job in enumerate(jobs)}
    return sorted([*missing, *changed], key=order.__getitem__)


def _outcomes(jobs: Sequence[Job], options: EvaluateOptions) -> Generator[Outcome, None, None]:
    if not jobs:
        return
    if options.engine == "dask":
        yield from run_on_dask(jobs, options.settings, options.scheduler)
    else:
        yield from run_in_processes(jobs, options.settings, options.jobs)


def _make_folders(options: EvaluateOptions) -> None:
    """Make the folders; ``settings.json`` tells readers the settings of these methods as well."""
    for folder in ("rows", "sides"):
        (options.out / folder).mkdir(parents=True, exist_ok=True)
    path = options.out / "settings.json"
    known = json.loads(path.read_text()) if path.exists() else {}
    for method in options.methods:
        known[method] = {
            "digest": options.settings.digest(method),
            "settings": options.settings.of(method),
        }
    path.write_text(json.dumps(known, indent=1, default=str))


def _read(path: Path) -> dict[str, Any]:
    """Read a row back.

    Raises
    ------
    ValueError
        It is damaged.
    """
    row: Any = json.loads(path.read_text(encoding="utf-8"))
    if not isinstance(row, dict) or not row.keys() >= _NEEDED:
        raise ValueError(path)
    return row


def _given(data: Path | None) -> Path:
    if data is None:
        raise UsageError("--data is missing: a folder with label volumes")
    return data


def _chosen(labels: Sequence[Path], cases: Sequence[str], where: object) -> list[Path]:
    """Return the labels of these cases, of all without any; ``where`` they were looked for."""
    names = {label: {case_stem(label), case_name(label)} for label in labels}
    known = set().union(*names.values())
    unknown = [case for case in cases if case not in known]
    if unknown:
        raise UsageError(f"cases: {', '.join(unknown)} is not in {where}")
    chosen = [label for label in labels if not cases or names[label] & set(cases)]
    first: dict[str, Path] = {}
    for label in chosen:
        other = first.setdefault(case_stem(label), label)
        if other != label:
            raise UsageError(f"{other} and {label} are both case {case_stem(label)}: rename one")
    return chosen

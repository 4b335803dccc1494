"""The folder of a training run, shared by every network.

``checkpoint.safetensors`` (weights, optimiser state, step), ``manifest.json`` (what was trained,
on what, with what), ``log.csv`` (one row per kind of scene and validation) and ``curve.png``; some
trainings also keep ``best.safetensors``, the checkpoint that did best on held-out generated scenes.
Each file is replaced whole, so an interruption at any moment leaves a folder to go on from.
"""

from __future__ import annotations

import collections
import contextlib
import csv
import json
import platform
import shutil
import signal
import threading
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol, TypeVar

import click
import numpy as np
import torch
from safetensors.torch import save

from gcar_deploy.batch.lock import only_one
from gcar_deploy.errors import ModelError, UsageError
from gcar_deploy.files import is_free, whole_file
from gcar_export.training.checkpoint import MEAN, WEIGHTS, best_weights, read_tensors, weights
from gcar_export.training.run_log import draw_curve, read_log
from gcar_export.training.scene_stream import Terminated

SCHEMA = "gcar-training/1"
#: keys of the manifest that a resumed run must share with the run it goes on from
FIXED = ("network", "config", "seed", "labels", "warm_start", "scenes", "segmenter")
#: options that may change on the way: how long, how often saved, by what it is worked on
FREE = (
    "steps", "decay_steps", "warmup_steps", "save_every", "workers", "device", "compiled",
    "validation_pictures",
)  # fmt: skip
#: finite losses whose mean is logged
RECENT = 250
#: what a training that was stopped before its first checkpoint leaves
_BEFORE = ("run.lock", "*.tmp", "pool", "fold-*-of-*")
#: what a manifest takes over from the one of the run that goes on
_KEPT = ("best", "validation", "skipped_steps")
T = TypeVar("T")


class RunFolder:
    """One training run on disk.

    Parameters
    ----------
    path : folder, made if there is none
    manifest : what is trained: ``network``, ``config``, ``seed``, ``labels`` (file name to
        SHA-256) and anything else worth keeping, as JSON knows it

    Raises
    ------
    UsageError
        The folder holds a run of another network, size, seed, set of labels, first weights or
        other options than those of ``FREE``, a checkpoint without its manifest, or something else.
    """

    def __init__(self, path: Path, manifest: Mapping[str, Any]) -> None:
        self.path = path
        self.manifest: dict[str, Any] = {"schema": SCHEMA, **manifest}
        #: kept in the checkpoint, so that a run that goes on logs what it would have logged
        self.losses: collections.deque[float] = collections.deque(maxlen=RECENT)
        self._scored = -1
        self._check_same()
        path.mkdir(parents=True, exist_ok=True)

    @property
    def checkpoint(self) -> Path:
        """Where the weights are."""
        return self.path / "checkpoint.safetensors"

    @property
    def _log(self) -> Path:
        return self.path / "log.csv"

    def _check_same(self) -> None:
        file = self.path / "manifest.json"
        if not file.is_file():
            if self.checkpoint.exists():
                raise UsageError(
                    f"{self.checkpoint} has no manifest.json beside it, which says what it was "
                    "trained on; give another --out"
                )
            if not is_free(self.path, _BEFORE):
                raise UsageError(f"{self.path} exists and holds no training; give another --out")
            return
        try:
            before = dict(json.loads(file.read_text(encoding="utf-8")))
        except (ValueError, TypeError):
            raise UsageError(f"{file} is not that of a training; give another --out") from None
        now = json.loads(json.dumps(self.manifest))
        pairs = {key: (before.get(key), now.get(key)) for key in FIXED}
        old, new = before.get("options") or {}, now.get("options") or {}
        # A run of an earlier version may lack an option that there is by now, and its pictures.
        pairs |= {key: (old[key], new[key]) for key in new if key in old and key not in FREE}
        if "real" in before:  # the pictures themselves say more than their folder's name
            pairs["real"] = before["real"], now.get("real")
        for key, (was, wanted) in pairs.items():
            if was != wanted:
                raise UsageError(
                    f"{self.path} holds a run with {_shown(key, was)}, this one has "
                    f"{_shown(key, wanted)}; give another --out, or the same {key}"
                    f"{' (what is not given is that of --preset)' if key in new else ''}"
                )
        if self.checkpoint.is_file():
            self.manifest |= {key: before[key] for key in _KEPT if key in before}
            # Weights are saved before they are scored: a row says that they were.
            rows = read_log(self._log)
            self._scored = max((int(r["step"]) for r in rows), default=-1)

    def took(self, loss: float) -> None:
        """Keep the loss of a step for the mean; one that is not finite has none."""
        if np.isfinite(loss):
            self.losses.append(loss)

    def scored(self, step: int) -> bool:
        """Whether what was learned up to ``step`` was scored."""
        return self._scored >= step

    def finished(self, steps: int) -> bool:
        """Whether all steps were taken and scored before; says so, and what does not fit."""
        self._say_what_is_odd()
        done = self._scored >= steps
        if done:
            click.echo(f"{self.path} is finished: {self._scored} steps", err=True)
        return done

    def _say_what_is_odd(self) -> None:
        """Say where checkpoint, manifest and log are not of one run, or not of one step."""
        manifest = self.path / "manifest.json"
        if not manifest.is_file():
            return
        if not self.checkpoint.is_file():
            beside = " and log.csv" if self._log.is_file() else ""
            click.echo(
                f"{self.path} has manifest.json{beside} but no {self.checkpoint.name}: begins anew",
                err=True,
            )
            return
        said = json.loads(manifest.read_text(encoding="utf-8")).get("step")
        step = int(read_tensors(self.checkpoint).get("step", torch.tensor(-1)))
        if said != step:
            click.echo(
                f"{self.checkpoint} is of step {step}, its manifest.json of step {said}: what the "
                "checkpoint holds counts",
                err=True,
            )
        # A log of another run, or of weights that are gone, scores nothing of these.
        self._scored = min(self._scored, step)

    def resume(
        self,
        net: torch.nn.Module,
        optimiser: torch.optim.Optimizer,
        mean: torch.nn.Module | None = None,
    ) -> int:
        """Load weights and optimiser state if there are any; return the step reached.

        ``mean`` takes the mean of the weights, or the weights where none was kept.

        Raises
        ------
        ModelError
            The checkpoint is damaged, or does not fit its manifest.
        """
        if not self.checkpoint.is_file():
            return 0
        data = read_tensors(self.checkpoint)
        try:
            load_weights(net, data)
            if mean is not None:
                mean.load_state_dict(best_weights(data))
            step = int(data["step"])
        except (RuntimeError, KeyError):
            raise ModelError(f"{self.checkpoint} does not fit its manifest.json") from None
        self.losses.extend(data.get("losses", torch.zeros(0)).tolist())
        state: dict[int, dict[str, torch.Tensor]] = {}
        for n, (name, _) in enumerate(net.named_parameters()):
            prefix = f"opt.{name}."
            own = {k[len(prefix) :]: v for k, v in data.items() if k.startswith(prefix)}
            if own:
                state[n] = own
        groups = optimiser.state_dict()["param_groups"]
        optimiser.load_state_dict({"state": state, "param_groups": groups})
        return step

    def save(
        self,
        net: torch.nn.Module,
        optimiser: torch.optim.Optimizer,
        step: int,
        extra: Mapping[str, Any] | None = None,
        mean: torch.nn.Module | None = None,
    ) -> None:
        """Write checkpoint and manifest; ``extra`` entries stay in later manifests.

        ``mean`` holds the mean of the weights, which is what will be exported.
        """
        data = {f"{WEIGHTS}{k}": _kept(v) for k, v in net.state_dict().items()}
        if mean is not None:
            data |= {f"{MEAN}{k}": _kept(v) for k, v in mean.state_dict().items()}
        for name, p in net.named_parameters():
            for key, value in optimiser.state.get(p, {}).items():
                data[f"opt.{name}.{key}"] = _kept(value)
        data["step"] = torch.tensor(step)
        data["losses"] = torch.tensor(list(self.losses), dtype=torch.float64)
        self.manifest.update(extra or {})
        self.manifest["step"] = step
        self.manifest["versions"] = {
            "torch": torch.__version__,
            "numpy": np.__version__,
            "python": platform.python_version(),
        }
        # A checkpoint is never without a manifest, not even if this is cut off here.
        if not (self.path / "manifest.json").is_file():
            self._write_manifest()
        with whole_file(self.checkpoint) as partial:
            partial.write_bytes(save(data))
        self._write_manifest()

    def interrupt(self, step: int) -> None:
        """Say where a run that was interrupted goes on."""
        click.echo(f"{self.path} is saved at step {step}; the same command goes on", err=True)

    def keep_best(self, step: int, error: float, scores: Mapping[str, Any]) -> None:
        """Copy the checkpoint just saved to best.safetensors if no earlier error was lower."""
        if error >= self.manifest.get("best", {"error": np.inf})["error"]:
            return
        with whole_file(self.path / "best.safetensors") as partial:
            shutil.copy(self.checkpoint, partial)
        self.manifest["best"] = {"step": step, "error": error, "validation": dict(scores)}
        self._write_manifest()

    def _write_manifest(self) -> None:
        text = json.dumps(self.manifest, indent=1) + "\n"
        with whole_file(self.path / "manifest.json") as partial:
            partial.write_text(text, encoding="utf-8")

    def log(self, step: int, scores: Mapping[str, Mapping[str, float]], validation: Any) -> None:
        """Add one validation (kind of scene -> measure -> value) to log.csv and redraw the curve.

        Rows of this step and later ones, left by a run that was cut off, are replaced. The manifest
        gets ``validation``.
        """
        self.manifest["validation"] = validation
        self._write_manifest()
        loss = float(np.mean(self.losses)) if self.losses else float("nan")
        names = list(next(iter(scores.values())))
        header = ["step", "loss", "kind", *names]
        file = self._log
        rows = [r for r in read_log(file) if int(r["step"]) < step]
        with whole_file(file) as partial, partial.open("w", newline="", encoding="utf-8") as f:
            writer = csv.DictWriter(f, header, extrasaction="ignore")
            writer.writeheader()
            writer.writerows(rows)
            for kind, score in scores.items():
                shown = {k: f"{v:.4f}" for k, v in score.items()}
                writer.writerow({"step": step, "loss": f"{loss:.4f}", "kind": kind, **shown})
        self._scored = step
        draw_curve(read_log(file), self.path / "curve.png")


def alone(folders: Sequence[RunFolder]) -> contextlib.ExitStack:
    """Hold the folders of a training, each by a lock that the system takes away with the process.

    What a training that was killed there left half written goes.

    Raises
    ------
    UsageError
        Another training is at work in one.
    """
    stack = contextlib.ExitStack()
    for folder in folders:
        try:
            stack.enter_context(only_one("training", folder.path, folder.path / "run.lock"))
        except UsageError:
            stack.close()
            raise
        for partial in folder.path.glob("*.tmp"):
            partial.unlink(missing_ok=True)
    return stack


def check_device(device: str) -> None:
    """Refuse a device that is not there.

    Raises
    ------
    UsageError
        ``cuda`` where torch finds none.
    """
    if device.startswith("cuda") and not torch.cuda.is_available():
        raise UsageError("preset gpu needs a CUDA device, and torch finds none; use cpu")


#: signals that end a training in good order
STOPS = (signal.SIGINT, signal.SIGTERM)


class Flag(Protocol):
    """What ``threading.Event`` and that of ``multiprocessing`` have in common."""

    def set(self) -> None:
        """Raise it."""

    def is_set(self) -> bool:
        """Tell whether it is up."""


@contextlib.contextmanager
def until_interrupted(stop: Flag | None = None) -> Iterator[Flag]:
    """Give a flag that Ctrl-C and SIGTERM raise: the training saves after its step.

    Schedulers send SIGTERM. A second one of either ends at once.

    Raises
    ------
    KeyboardInterrupt
        At the end, where the flag is up; ``Terminated`` where SIGTERM raised it.
    """
    stop = stop or threading.Event()
    main = threading.current_thread() is threading.main_thread()
    before = {number: signal.getsignal(number) for number in STOPS}
    raised: list[int] = []

    def back() -> None:
        for number, handler in before.items():
            signal.signal(number, handler)

    def interrupted(number: int, _: object) -> None:
        raised.append(number)
        back()
        stop.set()

    if main:
        for number in STOPS:
            signal.signal(number, interrupted)
    try:
        yield stop
    except KeyboardInterrupt:
        if raised == [signal.SIGTERM]:
            raise Terminated from None
        raise
    finally:
        if main:
            back()
    if stop.is_set():
        raise Terminated if raised == [signal.SIGTERM] else KeyboardInterrupt


def heeding(stop: Flag, items: Iterable[T]) -> Iterator[T]:
    """Yield the items as long as the flag is down: what is saved need not wait for its score.

    Raises
    ------
    KeyboardInterrupt
        The flag is up.
    """
    for item in items:
        if stop.is_set():
            raise KeyboardInterrupt
        yield item


class ProgressLine:
    """One line on stderr every few steps: step, mean loss, rate, time left."""

    def __init__(self, first: int, steps: int, per_step: int, what: str, every: int = 25) -> None:
        self.first, self.steps, self.per_step, self.what = first, steps, per_step, what
        self.every = every
        self.began = time.monotonic()

    def due(self, step: int) -> bool:
        """Whether it is its turn after ``step``."""
        return step % self.every == 0 or step == self.steps

    def show(self, step: int, losses: Iterable[float]) -> None:
        """Print after ``step`` if it is its turn."""
        if not self.due(step):
            return
        rate = (step - self.first) / max(time.monotonic() - self.began, 1e-9)
        left = (self.steps - step) / max(rate, 1e-9) / 60
        recent = list(losses)[-100:]
        # Scoring comes after the last step: no time is said to be left where it is not over.
        end = "scoring follows" if step >= self.steps else f"{np.ceil(left):.0f} min of steps left"
        click.echo(
            f"step {step}/{self.steps}  loss {np.mean(recent or [np.nan]):.4f}  "
            f"{rate * self.per_step:.2f} {self.what}/s  {end}",
            err=True,
        )


def load_weights(net: torch.nn.Module, data: Mapping[str, torch.Tensor]) -> None:
    """Put the ``net.`` entries of a checkpoint into a network."""
    net.load_state_dict(weights(data))


def _kept(value: torch.Tensor) -> torch.Tensor:
    return value.detach().cpu().clone().contiguous()


def _shown(key: str, value: Any) -> str:
    if key == "labels":
        return "no labels" if not value else f"{len(value)} label volumes ({', '.join(value)})"
    if key == "real" and isinstance(value, dict):
        return f"{len(value)} real pictures ({', '.join(value)[:60]})"
    return f"{key} = {value!r}"

"""Train the segmentation network on generated and real angiograms, in pieces of any length.

A run is a folder (``run_folder``). Picture i is a function of (seed, i), the learning rate one of
the step: a run that was stopped goes on where it was.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from gcar_deploy.errors import UsageError
from gcar_deploy.types import Array
from gcar_export.scenes.angiograms import SIDE, training_pair
from gcar_export.scenes.augmented import augmented_pair
from gcar_export.scenes.expert_pictures import (
    ExpertPicture,
    expert_pair,
    expert_pictures,
    fold_edges,
    folds,
    named,
)
from gcar_export.scenes.picture_pool import pooled
from gcar_export.training.loop import Lesson, Schedule, learn_together
from gcar_export.training.networks.mask_unet import MaskUNet, MaskUNetConfig
from gcar_export.training.run_folder import Flag, RunFolder, check_device, heeding
from gcar_export.training.scene_stream import leave_interrupts_to_the_parent
from gcar_export.training.segmenter_start import begin_with
from gcar_export.training.terms import begun

#: pictures with this seed are for choosing and reporting, never for training
VALIDATION_SEED = 90_002
#: stream of the pictures that are learned from, and how many new ones a step may meet
POOL_SEED, FRESH = 1, 3


@dataclasses.dataclass(frozen=True)
class SegmenterOptions:
    """Optimiser settings; the schedule is warm-up, constant, then linear to zero.

    Attributes
    ----------
    bfloat16 : bool, the network's layers in half the bits, its weights in single precision
    device : str, where torch works: ``cpu`` or ``cuda``
    real : str, folder of real angiograms with expert masks (``expert_pictures``); empty for none
    fold : (number, of how many) that is left out of them; (0, 0) leaves none out
    folds : int, networks that are trained beside it on the same batches, each without one of so
        many parts of the real pictures: what they say of it is said out of fold; 0 for none
    real_share : float, of the pictures of a step, where there are real ones
    pictures : int, generated ones that are drawn; each is used many times, never twice the same
    mean_steps : int, what is kept is the mean of the weights over about so many (``mean_weights``)
    crop : int, side of what is cut out of a picture, pixels; a multiple of the network's stride
    """

    seed: int = 1
    steps: int = 2000
    decay_steps: int = 1500
    warmup_steps: int = 50
    batch: int = 6
    learning_rate: float = 2e-3
    weight_decay: float = 1e-4
    validation_pictures: int = 40
    mean_steps: int = 200
    save_every: int = 50
    bfloat16: bool = True
    device: str = "cpu"
    real: str = ""
    fold: tuple[int, int] = (0, 0)
    folds: int = 0
    real_share: float = 0.5
    pictures: int = 1500
    crop: int = 224


#: two cores for an hour; a GPU with 16 cores to draw pictures for it, ten minutes
PRESETS = {
    "cpu": SegmenterOptions(),
    "gpu": SegmenterOptions(
        steps=4000,
        decay_steps=2700,
        warmup_steps=200,
        batch=32,
        pictures=6000,
        crop=SIDE,
        device="cuda",
        save_every=1000,
    ),
}
#: three steps, for tests
TINY = SegmenterOptions(
    steps=3,
    decay_steps=1,
    warmup_steps=1,
    batch=1,
    validation_pictures=2,
    save_every=2,
    pictures=2,
    crop=128,
)


def chosen(preset: str, given: Mapping[str, Any]) -> SegmenterOptions:
    """Return a preset's options with others in place of some; see ``changes``."""
    options = PRESETS[preset]
    return dataclasses.replace(options, **changes(options, given))


def changes(options: Schedule, given: Mapping[str, Any]) -> dict[str, Any]:
    """Return what changes in the options of a training with these; ``fold`` as ``K/N``.

    Raises
    ------
    UsageError
        A fold that is not two numbers.
    """
    out = dict(given)
    if "fold" in out:
        out["fold"] = fold_of(str(out["fold"]))
    if "real" in out:
        out["real"] = str(out["real"])
    steps = out.get("steps", options.steps)
    # A run that was made shorter decays and warms up within itself.
    out["decay_steps"] = min(out.get("decay_steps", options.decay_steps), steps)
    out["warmup_steps"] = max(1, min(out.get("warmup_steps", options.warmup_steps), steps // 4))
    return out


def fold_of(text: str) -> tuple[int, int]:
    """Read ``K/N``.

    Raises
    ------
    UsageError
        Not two numbers.
    """
    number, slash, of = text.partition("/")
    if not (slash and number.isdigit() and of.isdigit()):
        raise UsageError(f"fold {text}: must be K/N, for example 1/5")
    return int(number), int(of)


def mask_loss(logits: torch.Tensor, truth: torch.Tensor, weight: torch.Tensor) -> torch.Tensor:
    """Cross-entropy plus soft Dice over each picture (Milletari et al. 2016).

    All (n, rows, cols); pixels of weight 0 are asked neither way.
    """
    bce = torch.nn.functional.binary_cross_entropy_with_logits(logits, truth, weight=weight)
    p = torch.sigmoid(logits) * weight
    both = (p * truth).sum((1, 2))
    dice = 1 - (2 * both + 1) / (p.sum((1, 2)) + (truth * weight).sum((1, 2)) + 1)
    return bce + dice.mean()


def line_loss(logits: torch.Tensor, line: torch.Tensor) -> torch.Tensor:
    """Share of each picture's centreline that is not found (Kirchhoff et al. 2024).

    Thin vessels have as much of it as wide ones, but hardly any area.
    """
    found = (torch.sigmoid(logits) * line).sum((1, 2))
    return (1 - (found + 1) / (line.sum((1, 2)) + 1)).mean()


def chord_loss(chords: torch.Tensor, truth: torch.Tensor, weight: torch.Tensor) -> torch.Tensor:
    """Relative error of (n, rows, cols) chords in pixel edges, on the scale of log(1 + chord).

    Summed over all pixels, per pixel of vessel: what is no vessel must have no chord. A weight
    between 0 and 1 holds here as well; where the mask is unsure (0) the chord is not.
    """
    error = torch.nn.functional.smooth_l1_loss(
        torch.log1p(chords), torch.log1p(truth), beta=0.1, reduction="none"
    )
    error = error * torch.where(weight > 0, weight, 1.0)
    return (error.sum((1, 2)) / ((truth > 0.25).sum((1, 2)) + 500)).mean()


def total_loss(out: torch.Tensor, truth: torch.Tensor) -> torch.Tensor:
    """Of (n, 3, rows, cols) answers against (n, 6, rows, cols) truths of ``training_pair``."""
    mask, weight, chord, device, known, line = truth.unbind(1)
    # A catheter taken for vessel is built into the tree: its pixels count double.
    asked = weight * (1 + device)
    vessel = mask_loss(out[:, 0], mask, asked) + 2 * chord_loss(out[:, 1], chord, weight)
    lost = 0.5 * line_loss(out[:, 0], line)
    return vessel + lost + mask_loss(out[:, 2], device, known)


class Stream(torch.utils.data.Dataset):
    """Pictures 0 .. of a stream, made where and when they are asked for.

    Of each ``batch`` the first ``real_share`` are crops of real pictures, where there are any.
    An item is input, truth (both in half precision), and the number of the real picture, -1 for a
    generated one.
    """

    def __init__(
        self, options: SegmenterOptions, pool: Path, real: Sequence[ExpertPicture] = ()
    ) -> None:
        self.options, self.pool, self.real = options, pool, real

    def __len__(self) -> int:
        return self.options.steps * self.options.batch

    def __getitem__(self, index: int) -> tuple[torch.Tensor, torch.Tensor, int] | OSError:
        try:
            return self._item(index)
        except OSError as error:
            # Handed over: one that is raised in a worker loses its file's name.
            return error

    def _item(self, index: int) -> tuple[torch.Tensor, torch.Tensor, int]:
        cv2.setNumThreads(1)
        batch, seed, number = self.options.batch, self.options.seed, -1
        if self.real and index % batch < round(self.options.real_share * batch):
            x, y, number = expert_pair(self.real, seed, index)
        else:
            rng = np.random.default_rng([seed, index, 5])
            # The first steps need not wait for the whole pool.
            drawn = min(self.options.pictures, batch + FRESH * (index // batch))
            chosen = pooled(self.pool, POOL_SEED, int(rng.integers(drawn)))
            x, y = augmented_pair(rng, chosen)
        top, left = np.random.default_rng([seed, index, 4]).integers(
            0, SIDE - self.options.crop + 1, 2
        )
        part = slice(top, top + self.options.crop), slice(left, left + self.options.crop)
        cut = (torch.from_numpy(a[:, *part].astype(np.float16)) for a in (x, y))
        return next(cut), next(cut), number


def batches(
    options: SegmenterOptions, pool: Path, real: Sequence[ExpertPicture], first_step: int,
    workers: int,
) -> Iterator[list[torch.Tensor]]:  # fmt: skip
    """Yield each step's inputs (batch, 3, n, n), truths (batch, 6, n, n) and picture numbers.

    The last (batch,), as ``Stream`` gives them; the others are where torch works.
    """
    order = [
        list(range(k * options.batch, (k + 1) * options.batch))
        for k in range(first_step, options.steps)
    ]
    loader = torch.utils.data.DataLoader(
        Stream(options, pool, real), batch_sampler=order, num_workers=workers,
        pin_memory=options.device != "cpu", worker_init_fn=leave_interrupts_to_the_parent,
        collate_fn=_batch,
    )  # fmt: skip
    drawn = iter(loader)
    try:
        for found in drawn:
            if isinstance(found, OSError):
                raise found
            x, y, numbers = found
            yield [a.to(options.device, non_blocking=True) for a in (x, y)] + [numbers]
        return
    except BaseException as error:  # noqa: BLE001 - raised below
        failed = error.with_traceback(None)
    # The frames of a traceback hold the iterator, and it its processes, which heed no signal: they
    # would be waited for without end.
    del drawn
    raise failed


def _batch(items: list[Any]) -> Any:
    """Return the items of a batch together, or the first error among them."""
    failed = next((item for item in items if isinstance(item, OSError)), None)
    return torch.utils.data.default_collate(items) if failed is None else failed


@functools.cache
def _held_out(number: int) -> tuple[Array, Array]:
    return training_pair(VALIDATION_SEED, number)


@torch.no_grad()
def validate(net: MaskUNet, options: SegmenterOptions, stop: Flag) -> float:
    """Mean Dice at 0.5 over held-out generated pictures."""
    net.eval()
    scores = []
    for k in heeding(stop, range(options.validation_pictures)):
        x, y = (torch.from_numpy(a).to(options.device) for a in _held_out(k))
        asked = y[1] > 0
        found, true = (net(x[None])[0, 0] >= 0) & asked, (y[0] >= 0.5) & asked
        both = float((found & true).sum())
        scores.append(2 * both / max(float(found.sum() + true.sum()), 1.0))
    net.train()
    return float(np.mean(scores))


def real_pictures(real: str, fold: tuple[int, int]) -> tuple[ExpertPicture, ...]:
    """Return the pictures of a folder that a run trains on: all, or all but those of a fold.

    Raises
    ------
    UsageError
        A fold that there is not, or without pictures.
    """
    number, of = fold
    if (number, of) == (0, 0):
        return expert_pictures(Path(real)) if real else ()
    if not real:
        raise UsageError(f"fold {number}/{of} is of real pictures: give --real, the folder of all")
    if not (of >= 2 and 1 <= number <= of):
        raise UsageError(f"fold {number}/{of}: must be 1/n .. n/n (n >= 2) of real pictures")
    return folds(expert_pictures(Path(real)), number, of)[0]


def real_named(real: str, used: Sequence[ExpertPicture]) -> dict[str, Any]:
    """Return what a manifest says of the real pictures that are trained on."""
    return {"real": named(Path(real), used)} if used else {}


def train(
    out: Path, options: SegmenterOptions, *, minutes: float | None = None, workers: int = 1,
    begin_from: Path | None = None, pool: Path | None = None,
) -> None:  # fmt: skip
    """Train or go on training in ``out``; stop after ``minutes`` if given.

    The decay is a function of the step, so a run cut short has not settled: ``finish`` it by a
    call with fewer ``steps``. Networks of ``options.folds`` are in folders within it. A new run
    begins with the weights of ``begin_from`` if given, a checkpoint or an ONNX model. Generated
    pictures are kept in ``pool``, by default in ``out``.

    Raises
    ------
    UsageError
        No CUDA device where the options name one.
    """
    check_device(options.device)
    cv2.setNumThreads(1)
    real = real_pictures(options.real, options.fold)

    def batches_from(step: int) -> Iterator[list[torch.Tensor]]:
        return batches(options, pool or out / "pool", real, step, workers)

    pupils = []
    for fold, left_out in left_out_by(options, len(real)):
        torch.manual_seed(options.seed)
        net = MaskUNet(MaskUNetConfig()).to(options.device).train()
        # channels_last only orders the memory; the stubs of Module.to do not know it
        net.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        started = None if begin_from is None else begin_with(net, begin_from)
        lesson: Lesson[MaskUNet, list[torch.Tensor]] = Lesson(
            batches_from,
            functools.partial(_loss, net, options, left_out),
            lambda mean, stop: {"dice": validate(mean, options, stop)},
        )
        own = dataclasses.replace(options, fold=fold)
        where = out if fold == options.fold else out / f"fold-{fold[0]}-of-{fold[1]}"
        used = [one for k, one in enumerate(real) if k not in left_out]
        manifest = _manifest(net, own, started, begin_from) | real_named(options.real, used)
        pupils.append((RunFolder(where, manifest), net, lesson))
    learn_together(pupils, options, minutes)


def left_out_by(options: SegmenterOptions, count: int) -> list[tuple[tuple[int, int], range]]:
    """Return each network's fold and the numbers of the ``count`` real pictures it leaves out.

    Raises
    ------
    UsageError
        Folds of no pictures, of fewer than there are folds, or of those that a fold leaves.
    """
    of = options.folds
    if of and (options.fold != (0, 0) or not 2 <= of <= count):
        raise UsageError(f"folds {of}: must be 2 .. {count} of the real pictures, without --fold")
    edges = fold_edges(count, of).tolist() if of else []
    return [(options.fold, range(0))] + [
        ((k + 1, of), range(low, high)) for k, (low, high) in enumerate(itertools.pairwise(edges))
    ]


def _manifest(
    net: MaskUNet, options: SegmenterOptions, started: str | None, first: Path | None
) -> dict[str, Any]:
    data = "generated angiograms: gcar_export.scenes.picture_pool"
    data += "; crops of real ones with expert masks" if options.real else ""
    return {
        "network": "mask-unet",
        "config": dataclasses.asdict(net.config),
        "seed": options.seed,
        "options": dataclasses.asdict(options) | {"real": Path(options.real).name},
        "warm_start": started,
        **begun(first, data),
        "validation_seed": VALIDATION_SEED,
    }


def _loss(
    net: MaskUNet, options: SegmenterOptions, left_out: range, batch: Sequence[torch.Tensor]
) -> torch.Tensor | None:
    """Loss of a batch without what the network must not see; None where nothing is left."""
    keep = [k for k, number in enumerate(batch[2].tolist()) if number not in left_out]
    if not keep:
        return None
    x, y = (a[keep].float() for a in batch[:2])
    with torch.autocast(options.device, torch.bfloat16, enabled=options.bfloat16):
        maps = net(x.to(memory_format=torch.channels_last))
    return total_loss(maps.float(), y)

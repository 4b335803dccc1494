"""The loop of a training in one process: rate, step, mean of the weights, checkpoints, time."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Iterable
from typing import Generic, Protocol, TypeVar

import numpy as np
import torch

from gcar_export.training.mean_weights import MeanWeights
from gcar_export.training.run_folder import ProgressLine, RunFolder

N = TypeVar("N", bound=torch.nn.Module)
B = TypeVar("B")
#: the gradient is made no longer than this
_CLIP = 1.0
#: steps whose mean loss is told
_RECENT = 100


class Schedule(Protocol):
    """What the learning rate of a step depends on."""

    @property
    def steps(self) -> int:
        """Steps in all."""

    @property
    def decay_steps(self) -> int:
        """Of them the last ones, in which the rate falls to zero."""

    @property
    def warmup_steps(self) -> int:
        """Of them the first ones, in which it rises."""

    @property
    def learning_rate(self) -> float:
        """In between."""


class LoopOptions(Schedule, Protocol):
    """What else the loop has to know."""

    @property
    def weight_decay(self) -> float:
        """Of AdamW."""

    @property
    def mean_steps(self) -> int:
        """What is kept is the mean of the weights over about so many steps."""

    @property
    def save_every(self) -> int:
        """Steps from one checkpoint to the next."""

    @property
    def batch(self) -> int:
        """Pictures of a step."""


def learning_rate(options: Schedule, step: int) -> float:
    """Rate at ``step``: linear warm-up, constant, linear to zero over the last steps."""
    up = min(1.0, (step + 1) / options.warmup_steps)
    down = min(1.0, max(0.0, (options.steps - step) / max(options.decay_steps, 1)))
    return options.learning_rate * up * down


@dataclasses.dataclass(frozen=True)
class Lesson(Generic[N, B]):
    """What is learned.

    Attributes
    ----------
    batches : of the steps from the given one to the last
    loss_of : loss of a batch; None where it asks nothing
    validate : scores of a network on what is held out
    """

    batches: Callable[[int], Iterable[B]]
    loss_of: Callable[[B], torch.Tensor | None]
    validate: Callable[[N], dict[str, float]]


def learn(
    folder: RunFolder,
    net: N,
    options: LoopOptions,
    lesson: Lesson[N, B],
    minutes: float | None = None,
) -> None:
    """Train ``net`` or go on training it in ``folder``; stop after ``minutes`` if given.

    The mean of its weights is scored at the end and kept in the checkpoint beside them.
    """
    optimiser = torch.optim.AdamW(
        net.parameters(), lr=options.learning_rate, weight_decay=options.weight_decay
    )
    mean = MeanWeights(net, options.mean_steps)
    step = folder.resume(net, optimiser, mean.net)
    line = ProgressLine(step, options.steps, options.batch, "pictures")
    began = time.monotonic()
    losses: list[float] = []
    for batch in lesson.batches(step):
        if minutes is not None and time.monotonic() - began > 60 * minutes:
            break
        for group in optimiser.param_groups:
            group["lr"] = learning_rate(options, step)
        losses.append(_taken(lesson.loss_of(batch), net, optimiser))
        step += 1
        mean.add(net, step)
        line.show(step, losses)
        if step % options.save_every == 0 and step < options.steps:
            folder.save(net, optimiser, step, mean=mean.net)
    scores = lesson.validate(mean.net)
    folder.save(net, optimiser, step, {"validation": scores}, mean.net)
    recent = [loss for loss in losses[-_RECENT:] if np.isfinite(loss)]
    folder.log(step, float(np.mean(recent or [np.nan])), {"all": scores})


def _taken(
    loss: torch.Tensor | None, net: torch.nn.Module, optimiser: torch.optim.Optimizer
) -> float:
    """Take a step down the loss, unless its gradient is not finite; return the loss."""
    if loss is None:
        return float("nan")
    optimiser.zero_grad()
    loss.backward()
    norm = torch.nn.utils.clip_grad_norm_(net.parameters(), _CLIP)
    if bool(torch.isfinite(norm)):
        optimiser.step()
    return float(loss.detach())

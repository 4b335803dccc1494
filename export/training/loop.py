"""The loop of a training in one process: rate, step, mean of the weights, checkpoints, time."""

from __future__ import annotations

import contextlib
import dataclasses
import time
from collections.abc import Callable, Iterable, Sequence
from typing import Any, Generic, Protocol, TypeVar

import click
import torch

from gcar_export.training.mean_weights import MeanWeights
from gcar_export.training.run_folder import Flag, ProgressLine, RunFolder, alone, until_interrupted

N = TypeVar("N", bound=torch.nn.Module)
B = TypeVar("B")
#: the gradient is made no longer than this
_CLIP = 1.0


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


def precision(device: str, bf16: bool) -> contextlib.AbstractContextManager[Any]:
    """Within it a forward pass is in bfloat16 where that is wanted."""
    return torch.autocast(torch.device(device).type, torch.bfloat16, enabled=bf16)


@dataclasses.dataclass(frozen=True)
class Lesson(Generic[N, B]):
    """What is learned.

    Attributes
    ----------
    batches : of the steps from the given one to the last
    loss_of : loss of a batch; None where it asks nothing
    validate : scores of a network on what is held out; heeds the flag (``run_folder.heeding``)
    """

    batches: Callable[[int], Iterable[B]]
    loss_of: Callable[[B], torch.Tensor | None]
    validate: Callable[[N, Flag], dict[str, float]]


def learn(
    folder: RunFolder,
    net: N,
    options: LoopOptions,
    lesson: Lesson[N, B],
    minutes: float | None = None,
) -> None:
    """Train ``net`` or go on training it in ``folder``; stop after ``minutes`` if given.

    The mean of its weights is kept in the checkpoint beside them, and scored when all are saved.
    """
    learn_together([(folder, net, lesson)], options, minutes)


def learn_together(
    pupils: Sequence[tuple[RunFolder, N, Lesson[N, B]]],
    options: LoopOptions,
    minutes: float | None = None,
) -> None:
    """Train several networks, each in its folder, on the batches of the first one's lesson.

    What a network must not learn from a batch its own loss leaves out. Each ends as it would have
    alone.

    Raises
    ------
    KeyboardInterrupt
        On Ctrl-C or SIGTERM, when all are saved.
    """
    if all(folder.finished(options.steps) for folder, _, _ in pupils):
        return
    runs = [_Run(folder, net, options, lesson) for folder, net, lesson in pupils]
    step = min(run.step for run in runs)
    line = ProgressLine(step, options.steps, options.batch, "pictures")
    began = time.monotonic()
    with alone([folder for folder, _, _ in pupils]), until_interrupted() as stop:
        for batch in pupils[0][2].batches(step):
            if stop.is_set() or (minutes is not None and time.monotonic() - began > 60 * minutes):
                break
            for run in runs:
                # An interruption between two checkpoints leaves one network ahead.
                if run.step == step:
                    run.take(batch)
            step += 1
            if line.due(step):
                line.show(step, runs[0].folder.losses)
            if step % options.save_every == 0 and step < options.steps:
                for run in runs:
                    run.save()
        for run in runs:
            run.save()
        try:
            for run in runs:
                run.score(stop)
        finally:
            if stop.is_set() or step < options.steps:
                for run in runs:
                    run.folder.interrupt(run.step)


class _Run(Generic[N, B]):
    """One network with its optimiser, the mean of its weights, and its folder."""

    def __init__(
        self, folder: RunFolder, net: N, options: LoopOptions, lesson: Lesson[N, B]
    ) -> None:
        self.folder, self.net, self.options, self.lesson = folder, net, options, lesson
        self.optimiser = torch.optim.AdamW(
            net.parameters(), lr=options.learning_rate, weight_decay=options.weight_decay
        )
        self.mean = MeanWeights(net, options.mean_steps)
        self.step = folder.resume(net, self.optimiser, self.mean.net)

    def take(self, batch: B) -> None:
        """Take a step down the loss of a batch, unless its gradient is not finite."""
        for group in self.optimiser.param_groups:
            group["lr"] = learning_rate(self.options, self.step)
        loss = self.lesson.loss_of(batch)
        if loss is not None:
            self.optimiser.zero_grad()
            loss.backward()
            norm = torch.nn.utils.clip_grad_norm_(self.net.parameters(), _CLIP)
            if bool(torch.isfinite(norm)):
                self.optimiser.step()
            self.folder.took(float(loss.detach()))
        self.step += 1
        self.mean.add(self.net, self.step)

    def save(self) -> None:
        """Write the checkpoint."""
        self.folder.save(self.net, self.optimiser, self.step, mean=self.mean.net)

    def score(self, stop: Flag) -> None:
        """Score the mean of the weights that were saved, unless they were or ``stop`` is up."""
        if stop.is_set() or self.folder.scored(self.step):
            return
        click.echo(f"{self.folder.path} is saved at step {self.step}; it is scored now", err=True)
        scores = self.lesson.validate(self.mean.net, stop)
        self.folder.log(self.step, {"all": scores}, scores)
        told = ", ".join(f"{name} {value:.3f}" for name, value in scores.items())
        click.echo(f"{self.folder.path} at step {self.step}: {told} (held out)", err=True)

"""Train the network that tells catheters, leads and wires along lines, in pieces of any length.

The segmenter stays as it is: its answers are what lines are found by. Picture i is a function of
(seed, i), the learning rate one of the step: a run that was stopped goes on where it was. Real
pictures tell what is vessel, as an expert drew it; devices are drawn into them.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeAlias

import cv2
import numpy as np
import torch

from gcar_deploy.errors import UsageError
from gcar_deploy.imaging.line_strips import LinePoints, backwards, mirrored
from gcar_deploy.imaging.net import KIND, open_segmenter
from gcar_export.scenes.device_pictures import (
    DEVICE,
    NO_VESSEL,
    NOT_ASKED,
    OTHER,
    VESSEL,
    DevicePicture,
    generator,
    pooled_device_picture,
)
from gcar_export.scenes.expert_pictures import ExpertPicture
from gcar_export.training.loop import Lesson, learn
from gcar_export.training.networks.line_net import LineNet, LineNetConfig, no_vessel
from gcar_export.training.run_folder import Flag, RunFolder, heeding
from gcar_export.training.segmenter import changes, real_named, real_pictures
from gcar_export.training.segmenter_start import devices_of, vessels_sha256
from gcar_export.training.terms import begun

#: pictures of this seed are for choosing, never for training
VALIDATION_SEED = 90_003
#: new pictures that a step may meet: the first steps need not wait for all
FRESH = 3
#: what is known only to be no vessel counts so much; a point is called a device from here on
_VAGUE, _CALLED = 0.5, 0.8


@dataclasses.dataclass(frozen=True)
class DeviceOptions:
    """Optimiser settings; the schedule is warm-up, constant, then linear to zero.

    Attributes
    ----------
    batch : int, pictures of a step
    pictures : int, that are drawn; each is used many times, mirrored and walked backwards
    mean_steps : int, what is kept is the mean of the weights over about so many steps
    real : str, folder of real angiograms with expert masks (``expert_pictures``); empty for none
    fold : (number, of how many) that is left out of them; (0, 0) leaves none out
    """

    seed: int = 1
    steps: int = 6000
    decay_steps: int = 4000
    warmup_steps: int = 300
    batch: int = 8
    learning_rate: float = 2e-3
    weight_decay: float = 1e-2
    validation_pictures: int = 120
    save_every: int = 250
    mean_steps: int = 200
    pictures: int = 6000
    real: str = ""
    fold: tuple[int, int] = (0, 0)


#: points (n, POINT), near (n, NEAR) and labels (n,) of each picture of a step
Batch: TypeAlias = "list[tuple[torch.Tensor, torch.Tensor, torch.Tensor]]"
#: three steps, for tests
TINY = DeviceOptions(
    steps=3, decay_steps=1, warmup_steps=1, batch=1, validation_pictures=1, save_every=2,
    pictures=2,
)  # fmt: skip


def chosen(given: Mapping[str, Any]) -> DeviceOptions:
    """Return the options with others in place of some; see ``segmenter.changes``."""
    options = DeviceOptions()
    return dataclasses.replace(options, **changes(options, given))


def points_loss(logits: torch.Tensor, label: torch.Tensor) -> torch.Tensor:
    """Sum of the cross-entropies of (n, classes) logits, (n,) labels of ``device_pictures``."""
    said = torch.log_softmax(logits, dim=1)
    right = -said.gather(1, label.clamp(VESSEL, OTHER)[:, None])[:, 0]
    vague = -_VAGUE * torch.logsumexp(said[:, DEVICE:], dim=1)
    each = torch.where(label == NO_VESSEL, vague, right)
    return each[label != NOT_ASKED].sum()


def varied(rng: np.random.Generator, lines: LinePoints, label: Any) -> tuple[Any, Any]:
    """Points and labels of the same lines, mirrored and walked backwards at random."""
    points = lines.points
    if rng.integers(2):
        points = mirrored(points)
    if rng.integers(2):
        points = backwards(points, lines.lengths)
        label = np.concatenate([one[::-1] for one in np.split(label, np.cumsum(lines.lengths))])
    return points, label


class Pictures:
    """Pictures of a run, drawn where the pool does not hold them yet."""

    def __init__(
        self, options: DeviceOptions, pool: Path, model: Path, real: tuple[ExpertPicture, ...]
    ) -> None:
        self.options, self.pool, self.real = options, pool, real
        self.segmenter = open_segmenter(model, threads=1)
        self.sha256 = vessels_sha256(model)
        self.stream = generator(self.sha256, real)

    def one(self, seed: int, index: int) -> DevicePicture:
        """Picture ``index`` of the stream ``seed``."""
        return pooled_device_picture(self.pool, self.stream, seed, index, self.segmenter, self.real)

    def batch(self, step: int) -> Batch:
        """Points (n, POINT), near (n, NEAR) and labels (n,) of each picture of a step."""
        some = []
        for k in range(self.options.batch):
            rng = np.random.default_rng([self.options.seed, step, k, 8])
            drawn = min(self.options.pictures, self.options.batch + FRESH * step)
            picture = self.one(self.options.seed, int(rng.integers(drawn)))
            if len(picture.label):
                some.append(tensors(*varied(rng, picture.lines, picture.label), picture.lines.near))
        return some


def tensors(points: Any, label: Any, near: Any) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Points, near and labels as the network takes them."""
    given = (np.ascontiguousarray(points, np.float32), near, label.astype(np.int64))
    one, two, three = (torch.from_numpy(np.ascontiguousarray(a)) for a in given)
    return one, two, three


@torch.no_grad()
def validate(net: LineNet, pictures: Pictures, stop: Flag) -> dict[str, float]:
    """Share of devices' and of vessels' points called a device; devices found at 1 % of vessel."""
    net.eval()
    said, truth = [np.zeros(0)], [np.zeros(0)]
    for k in heeding(stop, range(pictures.options.validation_pictures)):
        picture = pictures.one(VALIDATION_SEED, k)
        if len(picture.label):
            points, near, _ = tensors(picture.lines.points, picture.label, picture.lines.near)
            said.append(no_vessel(net(points, near)).numpy())
            truth.append(picture.label)
    net.train()
    told, label = np.concatenate(said), np.concatenate(truth)
    device, vessel = told[label == DEVICE], told[label == VESSEL]
    level = np.quantile(vessel, 0.99) if len(vessel) else 1.0
    shares = {"found": device >= _CALLED, "vessel lost": vessel >= _CALLED,
              "found at 1 % lost": device >= level}  # fmt: skip
    return {name: float(np.mean(share)) if len(share) else 0.0 for name, share in shares.items()}


def train(
    out: Path,
    options: DeviceOptions,
    *,
    minutes: float | None = None,
    pool: Path | None = None,
    begin_from: Path | None = None,
    segmenter_model: Path | None = None,
) -> None:
    """Train or go on training in ``out``; stop after ``minutes`` if given.

    Lines are those that ``segmenter_model`` finds, an ONNX file; by default the one that comes
    along.

    The decay is a function of the step, so a run cut short has not settled: ``finish`` it by a
    call with fewer ``steps``. Pictures are kept in ``pool``, by default in ``out``. The first
    weights are random, or those of the model ``begin_from``.

    Raises
    ------
    ModelError
        ``begin_from`` holds no device network of this size, or ``segmenter_model`` is none.
    """
    cv2.setNumThreads(1)
    torch.manual_seed(options.seed)
    segmenter_model = segmenter_model or KIND.path
    if segmenter_model is None:
        raise UsageError("lines are found by the segmenter, and none is installed")
    real = real_pictures(options.real, options.fold)
    pictures = Pictures(options, pool or out / "pool", segmenter_model, real)
    net = LineNet(LineNetConfig()).train()
    first = None if begin_from is None else devices_of(net, begin_from)
    data = "gcar_export.scenes.device_pictures"
    data += "; real ones with expert masks tell what is vessel" if options.real else ""
    folder = RunFolder(
        out,
        {
            "network": "line-net",
            "config": dataclasses.asdict(net.config),
            "seed": options.seed,
            "options": dataclasses.asdict(options) | {"real": Path(options.real).name},
            "segmenter": pictures.sha256,
            "warm_start": first,
            "validation_seed": VALIDATION_SEED,
            **begun(begin_from, data, devices=True),
            **real_named(options.real, real),
        },
    )
    lesson: Lesson[LineNet, Batch] = Lesson(
        lambda step: (pictures.batch(k) for k in range(step, options.steps)),
        lambda batch: _loss(net, batch),
        lambda mean, stop: validate(mean, pictures, stop),
    )
    learn(folder, net, options, lesson, minutes)


def _loss(net: LineNet, batch: Batch) -> torch.Tensor | None:
    asked = sum(int((label != NOT_ASKED).sum()) for *_, label in batch)
    if not asked:
        return None
    parts = [points_loss(net(points, near), label) for points, near, label in batch]
    return torch.stack(parts).sum() / asked

"""Train a network of its own for catheters, leads and wires, in pieces of any length.

The segmenter stays as it is: its answers are part of the input. Picture i is a function of (seed,
i), the learning rate one of the step: a run that was stopped goes on where it was. Real pictures
tell what is no device: vessels as an expert drew them; devices are drawn into them.
"""

from __future__ import annotations

import dataclasses
import hashlib
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from torch.nn import functional

from gcar_deploy.errors import UsageError
from gcar_deploy.imaging.net import KIND
from gcar_export.scenes.device_pictures import (
    VESSEL,
    DevicePicture,
    cropped,
    generator,
    pooled_device_picture,
    turned,
)
from gcar_export.scenes.expert_pictures import ExpertPicture
from gcar_export.training.mean_weights import MeanWeights
from gcar_export.training.networks.device_unet import DeviceUNet, DeviceUNetConfig
from gcar_export.training.run_folder import ProgressLine, RunFolder
from gcar_export.training.segmenter import changes, learning_rate, real_pictures
from gcar_export.training.segmenter_start import devices_of, frozen_segmenter

#: pictures of this seed are for choosing, never for training
VALIDATION_SEED = 90_003
#: new pictures that a step may meet: the first steps need not wait for all
FRESH = 3
#: sides of the crops of a step, pixels: vessels leave the field too, not devices alone
CROPS = (224, 256, 288, 352)
#: Dice of a picture with next to no device says little
_DICE_PX = 20.0


@dataclasses.dataclass(frozen=True)
class DeviceOptions:
    """Optimiser settings; the schedule is warm-up, constant, then linear to zero.

    Attributes
    ----------
    pictures : int, that are drawn; each is used many times, turned
    mean_steps : int, what is kept is the mean of the weights over about so many steps
    real : str, folder of real angiograms with expert masks (``expert_pictures``); empty for none
    fold : (number, of how many) that is left out of them; (0, 0) leaves none out
    """

    seed: int = 1
    steps: int = 2000
    decay_steps: int = 800
    warmup_steps: int = 50
    batch: int = 6
    learning_rate: float = 2e-3
    weight_decay: float = 1e-4
    validation_pictures: int = 24
    save_every: int = 100
    mean_steps: int = 300
    pictures: int = 1500
    real: str = ""
    fold: tuple[int, int] = (0, 0)


#: three steps, for tests
TINY = DeviceOptions(
    steps=3, decay_steps=1, warmup_steps=1, batch=1, validation_pictures=1, save_every=2,
    pictures=2,
)  # fmt: skip


def chosen(given: Mapping[str, Any]) -> DeviceOptions:
    """Return the options with others in place of some; see ``segmenter.changes``."""
    options = DeviceOptions()
    return dataclasses.replace(options, **changes(options, given))


def asked_at_half(device: torch.Tensor, weight: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Truth and weight of (n, rows, cols) at half the resolution; thin lines stay lines.

    Where a vessel and a device share a pixel, neither is asked.
    """
    truth = functional.max_pool2d(device[:, None], 2)[:, 0]
    most = functional.max_pool2d(weight[:, None], 2)[:, 0]
    own = functional.max_pool2d((weight * device)[:, None], 2)[:, 0]
    asked = torch.where(truth > 0, torch.where(most >= VESSEL, 0.0, own), most)
    return truth, asked


def device_loss(logits: torch.Tensor, truth: torch.Tensor, weight: torch.Tensor) -> torch.Tensor:
    """Cross-entropy plus soft Dice of each picture, (n, rows, cols) each; weight 0 is not asked."""
    bce = functional.binary_cross_entropy_with_logits(logits, truth, weight=weight, reduction="sum")
    p = torch.sigmoid(logits) * weight
    both = (p * truth).sum((1, 2))
    total = p.sum((1, 2)) + (truth * weight).sum((1, 2))
    dice = 1 - (2 * both + _DICE_PX) / (total + _DICE_PX)
    return bce / weight.sum().clamp(min=1.0) + dice.mean()


class Pictures:
    """Pictures of a run, drawn where the pool does not hold them yet."""

    def __init__(
        self, options: DeviceOptions, pool: Path, model: Path, real: tuple[ExpertPicture, ...]
    ) -> None:
        self.options, self.pool, self.real = options, pool, real
        self.segmenter = frozen_segmenter(model)
        self.sha256 = hashlib.sha256(model.read_bytes()).hexdigest()
        self.stream = generator(self.sha256, real)

    def one(self, seed: int, index: int) -> DevicePicture:
        """Picture ``index`` of the stream ``seed``."""
        return pooled_device_picture(self.pool, self.stream, seed, index, self.segmenter, self.real)

    def batch(self, step: int) -> list[torch.Tensor]:
        """Channels (batch, 6, n, n), device and weight (batch, n, n) of a step."""
        side = int(np.random.default_rng([self.options.seed, step, 9]).choice(CROPS))
        some = []
        for k in range(self.options.batch):
            rng = np.random.default_rng([self.options.seed, step, k, 8])
            drawn = min(self.options.pictures, self.options.batch + FRESH * step)
            picture = self.one(self.options.seed, int(rng.integers(drawn)))
            some.append(turned(rng, cropped(rng, picture, side)))
        return stacked(some)


def stacked(some: list[DevicePicture]) -> list[torch.Tensor]:
    """Channels, device and weight of some pictures, as single precision."""
    names = ("channels", "device", "weight")
    return [torch.from_numpy(np.stack([getattr(p, n) for p in some])).float() for n in names]


@torch.no_grad()
def validate(net: DeviceUNet, pictures: Pictures) -> dict[str, float]:
    """Share of devices' pixels found at 0.5, and of vessels' pixels taken for one."""
    net.eval()
    found, lost = [], []
    for k in range(pictures.options.validation_pictures):
        channels, device, weight = stacked([pictures.one(VALIDATION_SEED, k)])
        truth, asked = asked_at_half(device, weight)
        said = net(channels)[:, 0] >= 0
        on, vessel = (truth > 0) & (asked > 0), (truth == 0) & (asked >= VESSEL)
        found += said[on].tolist()
        lost += said[vessel].tolist()
    net.train()
    return {"found": float(np.mean(found or [0])), "vessel lost": float(np.mean(lost or [0]))}


def train(
    out: Path,
    options: DeviceOptions,
    *,
    minutes: float | None = None,
    pool: Path | None = None,
    begin_from: Path | None = None,
) -> None:
    """Train or go on training in ``out``; stop after ``minutes`` if given.

    The decay is a function of the step, so a run cut short has not settled: ``finish`` it by a
    call with fewer ``steps``. Pictures are kept in ``pool``, by default in ``out``. The first
    weights are random, or those of the model ``begin_from``.

    Raises
    ------
    ModelError
        ``begin_from`` holds no device network of this size.
    """
    cv2.setNumThreads(1)
    torch.manual_seed(options.seed)
    if KIND.path is None:
        raise UsageError("the device network stands on a segmenter, and none is installed")
    real = real_pictures(options.real, options.fold)
    pictures = Pictures(options, pool or out / "pool", KIND.path, real)
    net = DeviceUNet(DeviceUNetConfig()).train()
    first = None if begin_from is None else devices_of(net, begin_from)
    # channels_last only orders the memory; the stubs of Module.to do not know it
    net.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    optimiser = torch.optim.AdamW(
        net.parameters(), lr=options.learning_rate, weight_decay=options.weight_decay
    )
    folder = RunFolder(
        out,
        {
            "network": "device-unet",
            "config": dataclasses.asdict(net.config),
            "seed": options.seed,
            "options": dataclasses.asdict(options) | {"real": Path(options.real).name},
            "segmenter": pictures.sha256,
            "warm_start": first,
            "data": "gcar_export.scenes.device_pictures"
            + ("; real ones with expert masks tell what is vessel" if options.real else ""),
        },
    )
    mean = MeanWeights(net, options.mean_steps)
    step = folder.resume(net, optimiser, mean.net)
    line = ProgressLine(step, options.steps, options.batch, "pictures")
    began = time.monotonic()
    losses: list[float] = []
    while step < options.steps and (minutes is None or time.monotonic() - began < 60 * minutes):
        for group in optimiser.param_groups:
            group["lr"] = learning_rate(options, step)
        losses.append(_step(net, optimiser, pictures.batch(step)))
        step += 1
        mean.add(net, step)
        line.show(step, losses)
        if step % options.save_every == 0 and step < options.steps:
            folder.save(net, optimiser, step, mean=mean.net)
    scores = validate(mean.net, pictures)
    told = {"validation": scores, "validation_seed": VALIDATION_SEED}
    folder.save(net, optimiser, step, told, mean.net)
    folder.log(step, float(np.mean(losses[-100:] or [np.nan])), {"all": scores})


def _step(net: DeviceUNet, optimiser: torch.optim.Optimizer, batch: list[torch.Tensor]) -> float:
    channels, device, weight = batch
    # Half the bits for the layers, single precision for the weights: half the time.
    with torch.autocast("cpu", torch.bfloat16):
        logits = net(channels.to(memory_format=torch.channels_last))
    loss = device_loss(logits.float()[:, 0], *asked_at_half(device, weight))
    optimiser.zero_grad()
    loss.backward()
    norm = torch.nn.utils.clip_grad_norm_(net.parameters(), 1.0)
    if bool(torch.isfinite(norm)):
        optimiser.step()
    return float(loss.detach())

"""Tracing a network without what torch says to its own developers."""

from __future__ import annotations

import contextlib
import logging
import warnings
from collections.abc import Iterator

#: tells of operators of torchvision, which no network here has
_REGISTRATION = "torch.onnx._internal.exporter._registration"


@contextlib.contextmanager
def quiet_tracing() -> Iterator[None]:
    """Keep remarks on torchvision, deprecated classes of torch and names of axes from stderr.

    Where a program is written they come again.
    """
    logger = logging.getLogger(_REGISTRATION)
    before = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", r".*LeafSpec", FutureWarning)
            warnings.filterwarnings("ignore", r".*axis name: \w+ will not be used", UserWarning)
            yield
    finally:
        logger.setLevel(before)

"""Orders from elsewhere: held to the worker's folder, copied, done."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

from gcar_deploy.engine import Engine, check_target_of, deliver
from gcar_deploy.inputs.order import Order, parse_order
from gcar_deploy.worker.folder import AllowedFolder
from gcar_deploy.worker.order_folders import drop_scratch, new_scratch

_SUFFIX = re.compile(r"\.[A-Za-z0-9]{1,8}")


@dataclasses.dataclass(frozen=True)
class Received:
    """An order whose files are at hand.

    Attributes
    ----------
    order : Order
    scratch : the private folder that goes with it, or None
    folder : the one that its paths lie in, or None
    """

    order: Order
    scratch: Path | None = None
    folder: AllowedFolder | None = None

    @property
    def private(self) -> bool:
        """Whether the result is to stay in the private folder."""
        out = self.order.out
        return self.scratch is not None and out is not None and self.scratch in out.parents

    def said(self, error: Exception) -> str:
        """Return the text of an error; its paths are those that the order gave."""
        return str(error) if self.folder is None else self.folder.inside(str(error))

    def clean_inputs(self) -> None:
        """Remove the private copies of what the order named; a result among them stays."""
        if self.scratch is None or not self.private:
            self.clean()
            return
        for path in self.scratch.iterdir():
            if not path.is_dir():
                path.unlink(missing_ok=True)

    def clean(self) -> None:
        """Remove the private folder."""
        if self.scratch is not None:
            drop_scratch(self.scratch)


def receive(values: Any, folder: AllowedFolder | None) -> Received:
    """Read an order that names files.

    Parameters
    ----------
    values : JSON object, schema ``gcar-order/1``
    folder : every file must lie in it, and is copied first; None takes any path as it is

    Raises
    ------
    UsageError
        As ``parse_order``, or a path is not allowed.
    """
    order = parse_order(values)
    if folder is None:
        return Received(order)
    order = placed(order, folder)
    scratch = new_scratch()
    try:
        own = order.with_files(
            lambda name, path: folder.copy(str(path), scratch_file(scratch, name, str(path)))
        )
    except BaseException:
        drop_scratch(scratch)
        raise
    return Received(own, scratch, folder)


def placed(order: Order, folder: AllowedFolder) -> Order:
    """Return the order with its result folder inside the worker's."""
    out = None if order.out is None else folder.target(str(order.out))
    return dataclasses.replace(order, out=out)


def scratch_file(scratch: Path, name: str, given: str | None) -> Path:
    """Return where a file of an order is copied to: ``view1`` ... with the suffix of its name."""
    return scratch / f"{name}{suffix_of(given or '')}"


def suffix_of(name: str) -> str:
    """Suffix of a file name, from which its format is told; empty if it is an odd one."""
    suffix = Path(name).suffix
    return suffix.lower() if _SUFFIX.fullmatch(suffix) else ""


def do_order(
    engine: Engine,
    order: Order,
    on_progress: Callable[[str, float], None],
    cancel: Callable[[], bool],
    *,
    limit_s: float | None = None,
) -> tuple[dict[str, Any], Path]:
    """Reconstruct and write the result folder.

    Parameters
    ----------
    limit_s : the longest deadline that is granted

    Returns
    -------
    content of ``result.json`` without its list of files, the folder

    Raises
    ------
    GcarError
        As ``gcar run``.
    """
    check_target_of(order)
    result = engine.reconstruct_order(
        order, on_progress=on_progress, cancel=cancel, limit_s=limit_s
    )
    folder = deliver(result, order)
    return result.summary(), folder

"""The desk: all cases of one session, in folders below one, and the work that is done on them."""

from __future__ import annotations

import dataclasses
import re
import secrets
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from gcar_deploy.data.demo_case import demo_case
from gcar_deploy.engine import Engine, check_target_of, deliver
from gcar_deploy.errors import RefusedError, UsageError
from gcar_deploy.inputs.order import Order, load_order
from gcar_deploy.workbench.case import ORDER_NAME, RESULT_NAME, Case

MOST_CASES = 64
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,79}")


class Desk:
    """Cases of one session.

    Parameters
    ----------
    root : folder for new cases; made when the first one comes
    """

    def __init__(self, root: Path) -> None:
        self._root = root
        self._cases: dict[str, Case] = {}
        self._shelf: dict[str, Path] = {}
        self._lock = threading.Lock()

    @property
    def cases(self) -> list[str]:
        """Their names, the oldest first."""
        return list(self._cases)

    def case(self, case_id: str) -> Case | None:
        """Return a case by its name."""
        return self._cases.get(case_id)

    def new_folder(self, name: str) -> Path:
        """Make a folder for a new case, ``name`` or with a number behind it.

        Raises
        ------
        UsageError
            The name is odd, there are too many cases, or the folder cannot be made.
        """
        if not _NAME.fullmatch(name):
            raise UsageError(f"case {name[:80]!r} must be letters, digits, '.', '_' or '-'")
        if len(self._cases) >= MOST_CASES:
            raise UsageError(f"{MOST_CASES} cases are open; start again for more")
        with self._lock:
            number, folder = 1, self._root / name
            while folder.exists() or folder.name in self._cases:
                number += 1
                folder = self._root / f"{name}-{number}"
            try:
                folder.mkdir(parents=True)
            except OSError as error:
                raise UsageError(f"{folder} cannot be made ({error.strerror})") from None
        return folder

    def add(self, folder: Path, order: Order, names: Sequence[str] = ()) -> Case:
        """Put a case on the desk; ``folder`` is its own, ``names`` are its user's."""
        case = Case(folder, order, names)
        self._cases[case.id] = case
        return case

    def demo(self) -> Case:
        """Put the case on the desk that comes along."""
        case = demo_case()
        return self.add(self.new_folder("demo"), Order(views=case.pictures, geometry=case.geometry))

    def again(self, folder: Path) -> Case:
        """Put a case of an earlier session on the desk: its folder, or the result in it.

        Raises
        ------
        UsageError
            There is no order in it.
        """
        folder = case_folder(folder)
        order = load_order(folder / ORDER_NAME).with_files(
            lambda _, path: path.relative_to(folder) if folder in path.parents else path
        )
        return self.add(folder, order)

    def shelve(self, folder: Path) -> str:
        """Lay a result without its order beside, only to be looked at; return its key."""
        key = secrets.token_urlsafe(16)
        self._shelf[key] = folder.resolve()
        return key

    def file(self, key: str, name: str) -> tuple[Path, str] | None:
        """Folder and name of a file by the key in its address; None where nothing has it."""
        if key in self._shelf:
            return self._shelf[key], name
        case = next((case for case in self._cases.values() if case.key == key), None)
        if case is None:
            return None
        return (case.folder if name == ORDER_NAME else case.folder / RESULT_NAME), name

    def work(
        self, engine: Engine, order: Order, on_progress: Callable[[str, float], None], cancel: Any
    ) -> tuple[dict[str, Any], Path]:
        """Do the order of a case and remember its result; see ``worker.jobs.Work``."""
        case = next(c for c in self._cases.values() if c.folder == _parent(order))
        check_target_of(order)
        try:
            result = engine.reconstruct_order(
                order, on_progress=on_progress, cancel=cancel, on_step=case.take_step
            )
        except RefusedError as error:
            # What an earlier order gave is not what this one gives; its files stay.
            case.result = None
            case.say_refused(str(error))
            raise
        folder = deliver(result, order)
        case.say_refused(None)
        case.result, case.made_by = result, order
        return result.summary(), folder


def case_folder(folder: Path) -> Path:
    """Return the folder of a case: the one given, or that of which it is the result."""
    folder = folder.resolve()
    is_result = folder.name == RESULT_NAME and not (folder / ORDER_NAME).exists()
    return folder.parent if is_result else folder


def absolute(order: Order) -> Order:
    """Return an order whose files are named from anywhere."""
    return dataclasses.replace(order.relative_to(Path.cwd()), out=None)


def _parent(order: Order) -> Path | None:
    return None if order.out is None else order.out.parent

"""The worker's requests: paths, headers, bodies. What lies outside its folder stays there."""

from __future__ import annotations

import json
import random
import shutil
import tempfile
from pathlib import Path
from typing import Any

from gcar_deploy.errors import UsageError
from gcar_deploy.inputs.order import KEYS
from gcar_deploy.worker.folder import AllowedFolder
from gcar_deploy.worker.http import create_app
from gcar_deploy.worker.jobs import JobQueue
from tests.battery.cases import geometry, pictures
from tests.battery.damage import EDGES, changed, damaged
from tests.battery.kinds.common import generator
from tests.battery.pool import Case, FoundError

TOKEN = "token-of-the-battery"
#: in a file beside the worker's folder; no answer may hold it
SECRET = b"secret beside the folder"
_NAMES = (
    "view1.png", "view2.png", "geom.json", "../secret.txt", "/etc/hostname", "link", "deep/../..",
    "..\\secret.txt", "%2e%2e/secret.txt", "view1.png\x00.png", "C:secret", "", ".", "a" * 5000,
    "link/secret.txt", "//etc/hostname", "~/x", "\u202egnp", "missing.png", "./view1.png",
)  # fmt: skip
_PATHS = (
    "/", "/health", "/openapi.json", "/v1/reconstruct", "/v1/jobs/x", "/v1/jobs/../x",
    "/v1/jobs/%2e%2e/files/secret.txt", "/v1/jobs/x/files/..%2fsecret.txt", "/static/../secret.txt",
    "//etc/hostname", "/v1/jobs/" + "x" * 3000, "/\x00", "/v1/reconstruct?wait=nan",
    "/v1/reconstruct?wait=1e999", "/v1/jobs/x?wait=-1",
)  # fmt: skip


def make(seed: int) -> Case:
    """Return the fuzz case of requests to the worker."""
    views, scene = pictures(), geometry()

    def case(index: int, folder: Path) -> str:
        rng = generator("http", seed, index)
        root, scratch = folder / "root", folder / "scratch"
        for made in (root, scratch):
            made.mkdir()
        (folder / "secret.txt").write_bytes(SECRET)
        (root / "link").symlink_to(folder)
        for number, data in enumerate(views, start=1):
            (root / f"view{number}.png").write_bytes(data)
        (root / "geom.json").write_text(json.dumps(scene))
        tempfile.tempdir = str(scratch)
        queue = JobQueue(_work, most_waiting=2)
        try:
            app = create_app(queue, TOKEN, folder=AllowedFolder(root), body_mib=1)
            found = _ask(app.test_client(), folder, views, scene, rng)
        finally:
            queue.close()
            tempfile.tempdir = None
        left = {p.name for p in folder.iterdir()} - {"root", "scratch", "secret.txt"}
        if left or (folder / "secret.txt").read_bytes() != SECRET:
            raise FoundError(f"written outside: {left}")
        shutil.rmtree(root)
        return found

    return case


def _work(order: Any, on_progress: Any, cancel: Any) -> Any:
    """Read what the order names, so that a wrong path shows; reconstruct nothing."""
    for path in order.files.values():
        if SECRET in Path(path).read_bytes():
            raise UsageError(SECRET.decode())
    raise UsageError("read")


def _ask(client: Any, folder: Path, views: list[bytes], scene: Any, rng: random.Random) -> str:
    headers = {"Authorization": f"Bearer {TOKEN}"}
    allowed = True
    if rng.random() < 0.2:
        name, value = rng.choice(
            (("Authorization", "Bearer x"), ("Authorization", "\xff"), ("Host", "evil.example"),
             ("Origin", "http://evil.example"), ("Host", "127.0.0.1.evil.example"))
        )  # fmt: skip
        headers[name], allowed = value, False
    path = rng.choice(_PATHS) if rng.random() < 0.3 else "/v1/reconstruct?wait=5"
    method = rng.choice(("GET", "PUT", "DELETE", "PATCH", "OPTIONS", "POST"))
    if path.startswith("/v1/reconstruct") and rng.random() < 0.9:
        method = "POST"
    kind = rng.random()
    try:
        if kind < 0.5:
            body: Any = changed(_order(rng), rng) if rng.random() < 0.5 else _order(rng)
            data = json.dumps(body).encode("utf-8", "surrogatepass")
            data = damaged(data, rng) if rng.random() < 0.2 else data
            answer = client.open(path, method=method, headers=headers, data=data,
                                 content_type="application/json")  # fmt: skip
        else:
            data, mark = _multipart(views, scene, rng)
            answer = client.open(path, method=method, headers=headers, data=data,
                                 content_type=f"multipart/form-data; boundary={mark}")  # fmt: skip
    except (UnicodeError, ValueError):
        return "not to be sent"
    return _judged(answer, folder, allowed, path)


def _judged(answer: Any, folder: Path, allowed: bool, path: str) -> str:
    text = answer.get_data()
    if SECRET in text or str(folder).encode() in text or b"Traceback" in text:
        raise FoundError(f"{answer.status_code} tells too much: {text[:300]!r}")
    if answer.status_code == 500:
        raise FoundError(f"internal error for {path[:60]!r}: {text[:300]!r}")
    if not allowed and answer.status_code < 400 and not path.startswith(("/health", "/openapi")):
        raise FoundError(f"{answer.status_code} without leave for {path[:60]!r}")
    return f"status {answer.status_code}"


def _order(rng: random.Random) -> dict[str, Any]:
    names = [rng.choice(_NAMES) if rng.random() < 0.5 else "view1.png" for _ in range(2)]
    order: dict[str, Any] = {"views": names, "geometry": rng.choice(("geom.json", *_NAMES[:8]))}
    if rng.random() < 0.5:
        order["masks"] = {rng.choice(("1", "2", "3", "01", "\u0661", "")): rng.choice(_NAMES)}
    for key in KEYS:
        if key not in order and rng.random() < 0.1:
            order[key] = rng.choice((*_NAMES, *EDGES)) if key == "out" else rng.choice(EDGES)
    return {k: v for k, v in order.items() if not isinstance(v, int) or abs(v) < 2**70}


def _told(rng: random.Random) -> dict[str, Any]:
    """Options of an order, right as they stand."""
    known = {
        "strict": True, "frames": [1, None], "pixel_spacing_mm": 0.3, "pose": "off",
        "segmenter": "classic", "extras": ["glb"], "deadline_s": 5,
    }  # fmt: skip
    return {key: value for key, value in known.items() if rng.random() < 0.5}


def _multipart(views: list[bytes], scene: Any, rng: random.Random) -> tuple[bytes, str]:
    mark = "mark-of-the-battery"
    parts = [("view", "a.png", view) for view in views]
    parts.append(("geometry", None, json.dumps(changed(scene, rng)).encode("utf-8", "replace")))
    if rng.random() < 0.3:
        parts.append(("options", None, json.dumps(changed(_told(rng), rng)).encode()))
    if rng.random() < 0.3:
        parts[rng.randrange(len(parts))] = ("view", rng.choice(_NAMES), b"x" * rng.choice((0, 9)))
    if rng.random() < 0.3:
        parts.append(
            (rng.choice(("mask1", "mask9", "mask0", "mask")), rng.choice(_NAMES), views[0])
        )
    if rng.random() < 0.05:
        parts.append(("view", "b.png", bytes(2 * 2**20)))
    out = b""
    for name, file, content in parts:
        named = f'; filename="{file}"' if file else ""
        head = f'--{mark}\r\nContent-Disposition: form-data; name="{name}"{named}\r\n\r\n'
        out += head.encode("utf-8", "replace") + content + b"\r\n"
    out += f"--{mark}--\r\n".encode()
    return (damaged(out, rng) if rng.random() < 0.5 else out), mark

"""The examples of docs/host-guide.md in other languages, compiled and run where their tools are."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path

import pytest

from gcar_deploy.data.demo_case import demo_case

GUIDE = Path(__file__).parents[1] / "docs" / "host-guide.md"
PATIENCE_S = 300
#: what a Qt program has round the lines of the guide
QT_PROGRAM = """#include <QtWidgets>
int main(int argc, char **argv) {
    QApplication app(argc, argv);
    QProgressBar progress, *bar = &progress;
    const auto showReport = [&](const QString &path) {
        app.exit(QFile::exists(path) && bar->value() > 0 ? 0 : 3);
    };
    QTimer::singleShot(%d, [&] { app.exit(4); });
    %s
    const int code = app.exec();
    worker.closeWriteChannel();
    worker.waitForFinished();
    return code;
}
"""

pytestmark = pytest.mark.slow


def example(language: str) -> str:
    return re.search(rf"```{language}\n(.*?)```", GUIDE.read_text(encoding="utf-8"), re.DOTALL)[1]


@pytest.fixture
def folder(tmp_path):
    """The demo's pictures, as the examples name them."""
    case = demo_case()
    for path in (*case.pictures, case.geometry):
        shutil.copy(path, tmp_path)
    return tmp_path


def environment():
    """Ours, with the commands of this installation first."""
    path = os.pathsep.join([sysconfig.get_path("scripts"), os.environ.get("PATH", "")])
    return {**os.environ, "PATH": path, "GCAR_TOKEN": "a-token-of-the-tests"}


def run(command, folder, **more):
    done = subprocess.run(
        command, cwd=folder, capture_output=True, text=True, timeout=PATIENCE_S, **more
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_csharp(folder):
    if shutil.which("mcs") is None or shutil.which("mono") is None:
        pytest.skip("no C# compiler (mono-mcs, mono-runtime)")
    pytest.importorskip("waitress", reason="needs the serve extra")
    (folder / "Host.cs").write_text(example("csharp"), encoding="utf-8")
    run(["mcs", "-r:System.Net.Http", "-r:System.Runtime.Serialization", "Host.cs"], folder)
    worker = subprocess.Popen(
        [sys.executable, "-m", "gcar_deploy.cli.main", "serve", "--port", "0"],
        stderr=subprocess.PIPE, text=True, env=environment(),
    )  # fmt: skip
    try:
        address = re.search(r"http://127\.0\.0\.1:\d+", worker.stderr.readline())
        run(["mono", "Host.exe", address[0], "a-token-of-the-tests"], folder)
    finally:
        worker.terminate()
        worker.communicate(timeout=PATIENCE_S)
    assert "Research use only" in (folder / "report.html").read_text(encoding="utf-8")


def test_qt(folder):
    config = shutil.which("pkg-config")
    known = config and subprocess.run([config, "--exists", "Qt6Widgets"], check=False)
    if shutil.which("g++") is None or not known or known.returncode:
        pytest.skip("no Qt 6 (qt6-base-dev) or no g++")
    flags = run([config, "--cflags", "--libs", "Qt6Widgets"], folder).split()
    program = QT_PROGRAM % (1000 * PATIENCE_S, example("cpp"))
    (folder / "host.cpp").write_text(program, encoding="utf-8")
    run(["g++", "-std=c++17", "-fPIC", "host.cpp", "-o", "host", *flags], folder)
    run(["./host"], folder, env={**environment(), "QT_QPA_PLATFORM": "offscreen"})
    assert (folder / "result" / "result.json").is_file()

"""A patient's name in file names, folders, picture text and DICOM headers comes out nowhere."""

from __future__ import annotations

import gzip
import io
import json
import logging
import shutil
import struct
import zipfile
import zlib
from pathlib import Path

import pytest

from gcar_deploy.engine import Engine
from gcar_deploy.imaging.read import read_picture
from tests.cli.conftest import gcar, good_case  # noqa: F401 - a fixture

NAME, NUMBER, BORN = "ZZPATIENT^TEST", "ZZ-4711KV-ID", "19010203"
CANARIES = (NAME, NUMBER, BORN, "ZZPATIENT", "4711KV")


def unpacked(name: str, data: bytes) -> bytes:
    """What a reader of the file sees, beside its bytes."""
    if name.endswith(".gz"):
        return data + gzip.decompress(data)
    if name.endswith(".npz"):
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            return data + b"".join(archive.read(entry) for entry in archive.namelist())
    return data


def hits(where: str, data: bytes | str) -> list[str]:
    text = data if isinstance(data, bytes) else data.encode("utf-8", "replace")
    return [f"{canary} in {where}" for canary in CANARIES if canary.encode() in text]


def in_folder(folder: Path) -> list[str]:
    found = []
    for path in folder.rglob("*"):
        found += hits(f"a name: {path.name}", path.name)
        if path.is_file():
            found += hits(path.name, unpacked(path.name, path.read_bytes()))
    return found


def chunk(kind: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


@pytest.fixture
def patient(good_case, tmp_path):  # noqa: F811 - the imported fixture
    """The good case in a folder and files of the patient's name, who is in the pictures' text."""
    folder = tmp_path / f"{NAME} {BORN}"
    folder.mkdir()
    text = chunk(b"tEXt", b"Title\x00" + NAME.encode()) + chunk(
        b"tEXt", b"ID\x00" + NUMBER.encode()
    )
    for number in (1, 2):
        data = (good_case / f"view{number}.png").read_bytes()
        (folder / f"{NAME}_{NUMBER}_{number}.png").write_bytes(data[:33] + text + data[33:])
    shutil.copy(good_case / "geom.json", folder / f"{NUMBER}.json")
    return folder


def views(folder: Path) -> list[Path]:
    return sorted(folder.glob("*.png"))


@pytest.mark.slow
@pytest.mark.parametrize("predictor", ["none", "multi"])
@pytest.mark.req("REQ-39")
def test_nothing_of_the_patient_in_result_page_or_log(patient, tmp_path, predictor):
    out = tmp_path / "out"
    done = gcar(
        "run", *views(patient), "--geom", patient / f"{NUMBER}.json", "--out", out, "-v",
        "--predictor", predictor, "--json",
    )  # fmt: skip
    assert done.code == 0, done.err
    assert done.err.count("gcar: ") > 3, "there was a log to look at"
    said = json.loads(done.out)
    assert said.pop("out") == str(out)
    assert hits("stdout", json.dumps(said)) + hits("stderr", done.err) + in_folder(out) == []


@pytest.mark.req("REQ-39")
def test_validate_and_enhance(patient, tmp_path):
    looked = gcar("validate", *views(patient), "--geom", patient / f"{NUMBER}.json", "--json")
    assert looked.code == 0 and hits("validate", looked.out + looked.err) == []
    out = tmp_path / "steps"
    done = gcar("enhance", views(patient)[0], "--out", out)
    assert hits("enhance", done.out + done.err) + in_folder(out) == []


@pytest.mark.req("REQ-39")
def test_the_library_logs_no_name(patient, caplog):
    logger = logging.getLogger("gcar_deploy")
    before = logger.propagate
    logger.propagate = True
    try:
        with caplog.at_level(logging.DEBUG, logger="gcar_deploy"):
            read_picture(views(patient)[0])
            result = Engine(threads=1).reconstruct(views(patient), patient / f"{NUMBER}.json")
    finally:
        logger.propagate = before
    assert caplog.records and hits("log", caplog.text) == []
    assert hits("json", result.to_json()) == []


def test_an_error_names_the_file_but_no_folder(patient, tmp_path):
    """A refusal must say which file it means; where it lies is nobody's business."""
    bad = patient / "view.png"
    bad.write_bytes(b"no picture")
    done = gcar("run", bad, bad, "--geom", patient / f"{NUMBER}.json", "--out", tmp_path / "out")
    assert done.code == 3 and "view.png" in done.err and hits("stderr", done.err) == []


@pytest.mark.req("REQ-39")
def test_dicom_headers_stay_where_they_are(tmp_path):
    pytest.importorskip("pydicom", reason="needs the dicom extra")
    from gcar_deploy.selftest import tiny_case
    from tests.dicom.files import classic, save

    who = {"PatientName": NAME, "PatientID": NUMBER, "PatientBirthDate": BORN}
    folder = tmp_path / NAME
    folder.mkdir()
    for number, angiogram in enumerate(tiny_case()[0], start=1):
        pixels = 4000 - angiogram.pixels.clip(0, 3000)
        run = classic(
            pixels.astype("uint16")[None],
            PositionerPrimaryAngle=str(angiogram.carm.primary_angle_deg),
            PositionerSecondaryAngle=str(angiogram.carm.secondary_angle_deg),
            InstitutionName=NAME, StudyDescription=NUMBER, **who,
        )  # fmt: skip
        save(run, folder / f"{NAME}_{number}.dcm")
    runs, out = sorted(folder.iterdir()), tmp_path / "out"
    made = gcar("run", *runs, "--out", out, "-v", "--json", "--predictor", "none")
    assert made.code in (0, 6), made.err
    found = hits("stderr", made.err) + hits("stdout", made.out.replace(str(out), ""))
    scene = gcar("geometry", "from-dicom", *runs)
    assert scene.code == 0
    found += hits("geometry", scene.out + scene.err)
    assert found + (in_folder(out) if out.exists() else []) == []

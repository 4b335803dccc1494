"""The result folder: every file rendered in memory, then written all or nothing."""

from __future__ import annotations

import importlib.util
import json
from collections.abc import Collection, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from gcar_deploy.errors import UsageError
from gcar_deploy.inputs.order import EXTRAS
from gcar_deploy.output.folder import listed, write_folder
from gcar_deploy.output.overlay import Backdrop, backdrop, overlay, png_bytes
from gcar_deploy.output.report import report_html
from gcar_deploy.output.tables import (
    centerline_csv,
    centerline_vtp,
    diameters_csv,
    gaussians_npz,
    gaussians_ply,
)
from gcar_deploy.output.volume import nifti_bytes
from gcar_deploy.reconstruction import Reconstruction
from gcar_deploy.tree.surface import lumen_surface, stl_bytes

RESULT_FILE = "result.json"
#: lattice of the lumen surface: finer than a section every 0.8 mm, and still a few megabytes
SURFACE_EDGE_MM = 0.4


def render_files(result: Reconstruction, extras: Sequence[str] = ()) -> dict[str, bytes]:
    """File name -> content of everything in the folder, ``result.json`` last.

    ``result.json`` lists size and SHA-256 of every other file under ``files``.

    Parameters
    ----------
    extras : names of ``inputs.order.EXTRAS``

    Raises
    ------
    UsageError
        An extra is unknown, or needs a library that is not installed.
    """
    check_extras(extras)
    with ThreadPoolExecutor(1, "gcar-render") as pool:
        # Only what works long outside Python goes beside the rest: threads that both need Python
        # wait for each other longer than they gain. Marching cubes does not let go of it.
        occupancy = pool.submit(nifti_bytes, result.volume, result.grid)
        drawn = [pool.submit(_drawn, result, k) for k in range(len(result.views))]
        surface = lumen_surface(result.tree, SURFACE_EDGE_MM)
        ghosts = result.ghost_probability
        tables = {
            "gaussians.npz": gaussians_npz(result.gaussians),
            "gaussians.ply": gaussians_ply(result.gaussians),
            "centerline.vtp": centerline_vtp(result.tree, result.measured, ghosts),
            "centerline.csv": centerline_csv(result.tree, result.measured, ghosts),
            "diameters.csv": diameters_csv(result.lumen, result.measured),
        }
        summary = result.summary()
        pictures = [one.result() for one in drawn]
        files = {"volume.nii.gz": occupancy.result(), **tables, "surface.stl": stl_bytes(surface)}
    if "glb" in extras:
        from gcar_deploy.output.glb import glb_bytes

        files[EXTRAS["glb"]] = glb_bytes(surface)
    if "dicom-stl" in extras:
        from gcar_deploy.output.dicom_stl import dicom_stl_bytes

        files[EXTRAS["dicom-stl"]] = dicom_stl_bytes(
            files["surface.stl"], [angiogram.sha256 for angiogram in result.angiograms]
        )
    for number, (_, encoded) in enumerate(pictures, start=1):
        files[f"overlay_view{number}.png"] = encoded
    for number, angiogram in enumerate(result.angiograms, start=1):
        if angiogram.frame is not None:
            from gcar_deploy.output.frame_pictures import frame_png

            files[f"frame_view{number}.png"] = frame_png(angiogram)
    page = report_html(result, summary, [behind.picture for behind, _ in pictures])
    files["report.html"] = page.encode("utf-8")
    summary["files"] = listed(files)
    files[RESULT_FILE] = (json.dumps(summary, indent=1, allow_nan=False) + "\n").encode("utf-8")
    return files


def _drawn(result: Reconstruction, k: int) -> tuple[Backdrop, bytes]:
    """Draw view k; return what lies behind the tree, and the whole as PNG."""
    angiogram, view = result.angiograms[k], result.views[k]
    behind = backdrop(angiogram.pixels, result.unexplained[k], view.catheter)
    picture = overlay(behind, view, result.tree, result.quality.views[k], result.ghost_probability)
    return behind, png_bytes(picture)


def check_extras(extras: Sequence[str]) -> None:
    """Find out early whether extra files can be written; see ``render_files``."""
    if not isinstance(extras, Collection):
        raise UsageError(f"extras is a {type(extras).__name__}; give a list of {', '.join(EXTRAS)}")
    unknown = sorted(set(extras) - EXTRAS.keys())
    if unknown:
        raise UsageError(f"extra file {unknown[0]!r} is none of {', '.join(EXTRAS)}")
    if "dicom-stl" in extras and importlib.util.find_spec("pydicom") is None:
        raise UsageError("pydicom is not installed: pip install 'gcar[dicom]'")


def write_result(
    result: Reconstruction, out_dir: Path, *, force: bool = False, extras: Sequence[str] = ()
) -> Path:
    """Write the result folder, with the files of ``extras`` in it; see ``render_files``.

    Raises
    ------
    UsageError
        An extra cannot be written; the folder exists (without ``force``), is a link or a
        file, or cannot be made.
    GcarError
        The disk refused; nothing is left.
    """
    write_folder(out_dir, render_files(result, extras), force=force)
    return out_dir

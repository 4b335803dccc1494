"""Gaussians and centreline as files other programs read: npz, ply, vtp, csv."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Mapping, Sequence

import numpy as np

from gcar_deploy.gaussians.gaussians import Gaussians
from gcar_deploy.measure import Measured, Sections
from gcar_deploy.output.vtp import poly_data
from gcar_deploy.tree.tree import Branch, Tree
from gcar_deploy.types import Array, Scalars

#: zeroth spherical harmonic, of the 3DGS convention's colour f_dc
_SH0 = 0.28209479177387814
_RED = (0.86, 0.16, 0.16)
#: a viewer's opacity is a share; outside these its logit is no use
_OPACITY_RANGE = (0.01, 0.99)

#: entries of a covariance, in the order of a symmetric tensor in VTK
_ENTRIES = ("xx", "yy", "zz", "xy", "yz", "xz")
#: columns of diameters.csv behind the branch's number
SECTION_COLUMNS = (
    "arc_mm", "x_mm", "y_mm", "z_mm", "diameter_mm", "sigma_mm", "reference_mm", "measured",
)  # fmt: skip
_ROWS, _COLUMNS = [0, 1, 2, 0, 1, 0], [0, 1, 2, 1, 2, 2]


def npz_bytes(arrays: Mapping[str, Array | str | float]) -> bytes:
    """Lossless arrays; texts (units, frame) as 0-d string arrays, no pickles."""
    stream = io.BytesIO()
    # Not numpy.savez: a fixed date in every entry makes equal results equal byte for byte.
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_STORED) as archive:
        for name, value in arrays.items():
            entry = io.BytesIO()
            np.lib.format.write_array(entry, np.asarray(value), allow_pickle=False)
            archive.writestr(zipfile.ZipInfo(f"{name}.npy"), entry.getvalue())
    return stream.getvalue()


def gaussians_npz(gaussians: Gaussians) -> bytes:
    """Write every array of the Gaussians with its units."""
    arrays: dict[str, Array | str | float] = {
        "means_mm": gaussians.means_mm,
        "scales_mm": gaussians.scales_mm,
        "quaternions_wxyz": gaussians.quaternions_wxyz,
        "intensity": gaussians.intensity,
    }
    if gaussians.sigma_mm is not None:
        arrays["sigma_mm"] = gaussians.sigma_mm
    arrays["frame"] = "LPS, mm, origin at the isocentre"
    arrays["density"] = "intensity * exp(-0.5 d^T C^-1 d), C = R diag(scales^2) R^T; 1 = vessel"
    return npz_bytes(arrays)


def gaussians_ply(gaussians: Gaussians) -> bytes:
    """Binary PLY in the convention of 3D Gaussian splatting viewers.

    Scales are logs of mm, quaternions wxyz, opacity is the logit of the intensity, colour the
    zeroth harmonic of one red.
    """
    n = len(gaussians.means_mm)
    share = np.clip(gaussians.intensity, *_OPACITY_RANGE)
    columns = np.concatenate(
        [
            gaussians.means_mm,
            np.zeros((n, 3)),
            np.tile((np.array(_RED) - 0.5) / _SH0, (n, 1)),
            np.log(share / (1 - share))[:, None],
            np.log(np.maximum(gaussians.scales_mm, 1e-6)),
            gaussians.quaternions_wxyz,
        ],
        axis=1,
    )
    names = ["x", "y", "z", "nx", "ny", "nz", *(f"f_dc_{k}" for k in range(3)), "opacity"]
    names += [f"scale_{k}" for k in range(3)] + [f"rot_{k}" for k in range(4)]
    header = ["ply", "format binary_little_endian 1.0"]
    header += ["comment gcar; mm, patient LPS; scale_ log mm; rot_ wxyz; opacity logit"]
    header += [f"element vertex {n}", *(f"property float {name}" for name in names), "end_header"]
    return ("\n".join(header) + "\n").encode("ascii") + columns.astype("<f4").tobytes()


def centerline_vtp(tree: Tree, measured: Measured, ghosts: Sequence[Scalars]) -> bytes:
    """XML PolyData, one polyline per branch, mm LPS, for VMTK and 3D Slicer.

    A branch without a name has an empty ``VesselName`` and no (NaN) ``NameConfidence``. ``ghosts``
    are per branch (m,) probabilities of lying more than 2 mm from any vessel, NaN: not known.
    Covariances are mm^2 LPS in the order xx, yy, zz, xy, yz, xz; the whole one is the sum of both.
    """
    sizes = [len(branch) for branch in tree.branches]
    radius = tree.radii()
    point_data = {
        "MaximumInscribedSphereRadius": radius,
        "Radius": radius,
        "Sigma": _of_points(tree, "sigma_mm"),
        "Confidence": _of_points(tree, "confidence"),
        "GhostProbability": np.concatenate([np.zeros(0), *ghosts]),
    }
    for part, name in enumerate(("Fit", "Geometry")):
        point_data[f"Sigma{name}"], point_data[f"Covariance{name}"] = _spreads(tree, part)
    cell_data: dict[str, Array | Sequence[str]] = {
        "BranchId": np.arange(1, len(sizes) + 1, dtype=np.int64),
        "StartNode": np.array([branch.start for branch in tree.branches], dtype=np.int64),
        "EndNode": np.array([branch.end for branch in tree.branches], dtype=np.int64),
        "Length": np.array([branch.length_mm for branch in tree.branches], dtype=np.float64),
        "MinimalDiameter": _of_lumens(measured, "minimal_diameter_mm"),
        "ReferenceDiameter": _of_lumens(measured, "reference_diameter_mm"),
        "StenosisPercent": _of_lumens(measured, "stenosis_percent"),
        "LesionLength": _of_lumens(measured, "lesion_length_mm"),
    }
    told = _told(measured)
    cell_data["NameConfidence"] = np.array([share for _, share in told], dtype=np.float64)
    cell_data["VesselName"] = [name for name, _ in told]
    return poly_data(tree.points(), sizes, point_data, cell_data)


def centerline_csv(tree: Tree, measured: Measured, ghosts: Sequence[Scalars]) -> bytes:
    """One row per centreline point; an unknown sigma, ghost or name is an empty field.

    The covariance is the sum of fit and geometry. Branches are numbered from 1, as in the
    pictures, the report and ``centerline.vtp``. ``ghosts`` as there; ``confidence`` is the
    predictor's score, which ranks points but is not calibrated.
    """
    columns_of_points = ["arc_mm", "x_mm", "y_mm", "z_mm", "radius_mm", "sigma_mm", "confidence"]
    more = ["sigma_fit_mm", "sigma_geometry_mm", *(f"cov_{name}_mm2" for name in _ENTRIES)]
    last = ["name", "name_confidence", "ghost_probability", *more]
    rows = [",".join(["branch", "point", *columns_of_points, *last])]
    told = zip(tree.branches, _told(measured), ghosts, strict=True)
    for number, (branch, (name, share), ghost) in enumerate(told, 1):
        (fit, fit6), (geometry, geometry6) = _spread(branch, 0), _spread(branch, 1)
        spread = np.column_stack([fit, geometry, fit6 + geometry6])
        before = np.column_stack(
            [branch.arc_mm, branch.points_mm, branch.radius_mm, branch.sigma_mm, branch.confidence]
        )
        after = np.column_stack([np.full(len(branch), share), ghost, spread])
        fields = ["%d", *["%.5f"] * before.shape[1], name, *["%.5f"] * after.shape[1]]
        rows += _rows(number, fields, np.column_stack([np.arange(len(branch)), before, after]))
    return ("\n".join(rows) + "\n").encode("ascii")


def diameters_csv(lumen: tuple[Tree, tuple[Sections, ...]], measured: Measured) -> bytes:
    """One row per section: place, diameter with its standard deviation, reference.

    Branches are numbered from 1; ``measured`` is 0 where no view shows the lumen, and the diameter
    is what lies between those that are. Unknown values are empty fields.
    """
    rows = [",".join(["branch", *SECTION_COLUMNS])]
    tree, sections = lumen
    told = zip(tree.branches, sections, measured.lumens, strict=True)
    for number, (branch, own, figures) in enumerate(told, 1):
        columns = [
            own.arc_mm, branch.points_mm, own.diameter_mm, own.sigma_mm, figures.reference_mm,
            own.measured,
        ]  # fmt: skip
        fields = ["%.5f"] * (len(SECTION_COLUMNS) - 1) + ["%d"]
        rows += _rows(number, fields, np.column_stack(columns))
    return ("\n".join(rows) + "\n").encode("ascii")


def _rows(branch: int, fields: Sequence[str], numbers: Array) -> list[str]:
    """Lines of a branch; what is not finite is an empty field.

    A whole row at once: a call for each of some thousand fields is what would take the time.
    """
    form = ",".join([str(branch), *fields])
    known = np.where(np.isfinite(numbers), numbers, np.nan)
    return [(form % tuple(row)).replace("nan", "") for row in known.tolist()]


def _told(measured: Measured) -> list[tuple[str, float]]:
    """Name and its probability per branch; empty and NaN where there is none."""
    return [
        ("", float("nan")) if name is None else (name.name, name.confidence)
        for name in measured.names
    ]


def _spread(branch: Branch, part: int) -> tuple[Array, Array]:
    """(m,) sigma in the worst direction and (m, 6) covariance of the fit (0) or geometry (1)."""
    six: Array = np.full((len(branch), 6), np.nan)
    if branch.covariance_mm2 is not None:
        six = branch.covariance_mm2[:, part][:, _ROWS, _COLUMNS]
    return branch.sigma_parts_mm[:, part], six


def _spreads(tree: Tree, part: int) -> tuple[Array, Array]:
    """``_spread`` of all branches' points, in order."""
    each = [_spread(branch, part) for branch in tree.branches]
    sigma = np.concatenate([np.zeros(0), *(one for one, _ in each)])
    return sigma, np.concatenate([np.zeros((0, 6)), *(six for _, six in each)])


def _of_points(tree: Tree, name: str) -> Array:
    parts: Sequence[Array] = [getattr(branch, name) for branch in tree.branches]
    return np.concatenate(parts) if parts else np.zeros(0)


def _of_lumens(measured: Measured, name: str) -> Array:
    """(branches,) float64 figure of each branch, NaN where it is too short to say."""
    values = [getattr(lumen, name) for lumen in measured.lumens]
    return np.array([np.nan if value is None else value for value in values], dtype=np.float64)

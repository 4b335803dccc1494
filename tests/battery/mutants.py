"""The deliberate bugs, each with the tests that must notice it."""

from __future__ import annotations

import dataclasses

_CARM, _PROJECT = "tests/geometry/test_carm.py", "tests/gaussians/test_project.py"
_FOLDER = "tests/output/test_folder.py"
_SIGMA, _MODEL = "tests/tubes/test_uncertainty.py", "tests/tubes/test_oracle.py"


@dataclasses.dataclass(frozen=True)
class Mutant:
    """One bug.

    Attributes
    ----------
    name : what it does
    file : path in the repository
    old, new : text, and what stands there instead (wherever it occurs in the file)
    tests : files or names of tests; at least one must fail
    """

    name: str
    file: str
    old: str
    new: str
    tests: tuple[str, ...]


MUTANTS = (
    Mutant(
        "geometry: sign of the secondary angle",
        "gcar_deploy/geometry/matrix.py",
        "for x in (primary_deg, secondary_deg, rotation_deg))",
        "for x in (primary_deg, -secondary_deg, rotation_deg))",
        (_CARM,),
    ),
    Mutant(
        "geometry: degrees taken for radians",
        "gcar_deploy/geometry/matrix.py",
        "a, b, g = (math.radians(x) for x in",
        "a, b, g = (x for x in",
        (_CARM,),
    ),
    Mutant(
        "geometry: detector rotation the other way",
        "gcar_deploy/geometry/matrix.py",
        "return u * cg - v * sg, u * sg + v * cg, d",
        "return u * cg + v * sg, v * cg - u * sg, d",
        (_CARM,),
    ),
    Mutant(
        "geometry: rows and columns of the spacing swapped",
        "gcar_deploy/geometry/scene.py",
        "pixel_spacing_mm=(spacing[0], spacing[1]),",
        "pixel_spacing_mm=(spacing[1], spacing[0]),",
        ("tests/geometry/test_scene.py",),
    ),
    Mutant(
        "geometry: a key that stands twice is taken",
        "gcar_deploy/geometry/fields.py",
        "if key in out:",
        "if False:",
        ("tests/cli/test_bad_input.py::test_run_refuses[key twice]",),
    ),
    Mutant(
        "projection: half of the exponent lost",
        "gcar_deploy/gaussians/project.py",
        "-0.5 * w.exponent(f).astype(dtype)",
        "-1.0 * w.exponent(f).astype(dtype)",
        (_PROJECT,),
    ),
    Mutant(
        "projection: peak kept instead of mass",
        "gcar_deploy/gaussians/footprint.py",
        "unit_mass * kappa / (2 * np.pi * np.sqrt(determinant))",
        "np.sqrt(2 * np.pi) * gaussians.scales_mm.mean(axis=1)",
        (_PROJECT,),
    ),
    Mutant(
        "projection: covariance in half precision",
        "gcar_deploy/gaussians/footprint.py",
        "Sigma = half @ half.transpose(0, 2, 1)",
        "Sigma = (half @ half.transpose(0, 2, 1)).astype(np.float16).astype(np.float64)",
        (_PROJECT,),
    ),
    Mutant(
        "loss: gradient without its factor two",
        "gcar_deploy/gaussians/loss.py",
        "2.0 * weight * r",
        "weight * r",
        ("tests/gaussians/test_paper.py",),
    ),
    Mutant(
        "loss: the centreline's share and the picture's swapped",
        "gcar_deploy/gaussians/loss.py",
        "np.where(valid, alpha + (1.0 - alpha) * skeleton, 0.0)",
        "np.where(valid, (1.0 - alpha) + alpha * skeleton, 0.0)",
        ("tests/gaussians/test_paper.py",),
    ),
    Mutant(
        "pose: masks are moved by what overlaps in them",
        "gcar_deploy/pose/profile_fit.py",
        "uncovered_mm(fixed, moving, carm) <= most * told_mm",
        "told_mm <= np.inf",
        ("tests/pose/test_pairwise.py",),
    ),
    Mutant(
        "hashing: an altered model is loaded",
        "gcar_deploy/models/spec.py",
        'if digest != spec.get("sha256"):',
        "if False:",
        ("tests/predict/test_center_predictor.py::test_altered_model_is_refused",),
    ),
    Mutant(
        "hashing: the golden case is not compared",
        "gcar_deploy/models/golden.py",
        "if not np.allclose(answer, expected,",
        "if None is np.allclose(answer, expected,",
        ("tests/models/test_golden.py",),
    ),
    Mutant(
        "hashing: the picture's hash covers its beginning alone",
        "gcar_deploy/imaging/read.py",
        "sha256 = hashlib.sha256(data).hexdigest()",
        "sha256 = hashlib.sha256(data[:64]).hexdigest()",
        ("tests/imaging/test_read.py",),
    ),
    Mutant(
        "hashing: the manifest lists hashes of names",
        "gcar_deploy/output/folder.py",
        "hashlib.sha256(data).hexdigest()}",
        "hashlib.sha256(name.encode()).hexdigest()}",
        ("tests/output/test_files.py",),
    ),
    Mutant(
        "models: external data pass",
        "gcar_deploy/models/guard.py",
        "if number == 13 or (number == 14 and value != 0):",
        "if number == 13 and number == 14:",
        ("tests/models/test_guard.py",),
    ),
    Mutant(
        "models: values that are not finite pass",
        "gcar_deploy/models/session.py",
        "if not np.isfinite(answer).all():",
        "if answer.size < 0:",
        ("tests/models/test_session.py",),
    ),
    Mutant(
        "models: a missing segmenter is passed over in silence",
        "gcar_deploy/imaging/extract.py",
        'return segmenter, [] if segmenter or options.segmenter == "net" else [MISSING]',
        "return segmenter, []",
        ("tests/models/test_session.py",),
    ),
    Mutant(
        "models: nobody watches a running segmenter",
        "gcar_deploy/imaging/net.py",
        "return dataclasses.replace(self, should_stop=should_stop)",
        "return self",
        ("tests/models/test_session.py",),
    ),
    Mutant(
        "pictures: more data than the header promises pass",
        "gcar_deploy/imaging/png_guard.py",
        "if size != expected:",
        "if size < expected:",
        ("tests/imaging/test_read.py",),
    ),
    Mutant(
        "atomicity: files are copied into the place one by one",
        "gcar_deploy/output/folder.py",
        "_put(fresh, out_dir, scratch / OLD, force=force)",
        '__import__("shutil").copytree(fresh, out_dir, dirs_exist_ok=True)',
        (_FOLDER,),
    ),
    Mutant(
        "atomicity: the unfinished folder stays after an error",
        "gcar_deploy/scratch.py",
        "    shutil.rmtree(scratch, ignore_errors=True)\n    if handle",
        "    if handle",
        (_FOLDER,),
    ),
    Mutant(
        "atomicity: folders of living owners are swept",
        "gcar_deploy/scratch.py",
        "fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)",
        "pass",
        ("tests/test_scratch.py",),
    ),
    Mutant(
        "output: volume without the turn from LPS to RAS",
        "gcar_deploy/output/volume.py",
        "affine = grid.affine_ras()",
        "affine = np.diag([-1.0, -1.0, 1.0, 1.0]) @ grid.affine_ras()",
        ("tests/output/test_files.py",),
    ),
    Mutant(
        "worker: any token opens",
        "gcar_deploy/worker/loopback.py",
        "not hmac.compare_digest(given, expected)",
        "not given and expected",
        ("tests/worker/test_http.py",),
    ),
    Mutant(
        "sigma: half of what a result states",
        "gcar_deploy/tubes/fit.py",
        "covariance = np.stack([parts.fit, parts.geometry], axis=1)",
        "parts = type(parts)(parts.fit / 4, parts.geometry / 4)\n"
        "    covariance = np.stack([parts.fit, parts.geometry], axis=1)",
        (f"{_SIGMA}::test_errors_of_whole_fits_are_those_that_sigma_states",),
    ),
    Mutant(
        "sigma: half of the fit's part",
        "gcar_deploy/tubes/uncertainty.py",
        "return 0.5 * (out + np.swapaxes(out, 1, 2))",
        "return 0.125 * (out + np.swapaxes(out, 1, 2))",
        (f"{_SIGMA}::test_depth_and_plane_of_a_rigid_tube_are_the_cramer_rao_bounds",),
    ),
    Mutant(
        "sigma: half of it in depth",
        "gcar_deploy/tubes/uncertainty.py",
        "    out: Array = solved[row[:, :, None], back[:, None, :]]\n",
        "    out: Array = solved[row[:, :, None], back[:, None, :]] * [[1, .5, 1], [.5, .25, .5], "
        "[1, .5, 1]]\n",
        (f"{_SIGMA}::test_depth_and_plane_of_a_rigid_tube_are_the_cramer_rao_bounds",),
    ),
    Mutant(
        "sigma: half of it across the beams' bisector",
        "gcar_deploy/tubes/uncertainty.py",
        "    out: Array = solved[row[:, :, None], back[:, None, :]]\n",
        "    out: Array = solved[row[:, :, None], back[:, None, :]] * [[.25, .5, .5], [.5, 1, 1], "
        "[.5, 1, 1]]\n",
        (f"{_SIGMA}::test_depth_and_plane_of_a_rigid_tube_are_the_cramer_rao_bounds",),
    ),
    Mutant(
        "sigma: vessels that share rays do not couple",
        "gcar_deploy/tubes/hessian.py",
        "    for step in range(1, int(seen.crossings.max(initial=1))):",
        "    for step in range(1, 1):",
        ("tests/tubes/test_hessian.py",),
    ),
    Mutant(
        "sigma: half of the geometry's part",
        "gcar_deploy/tubes/uncertainty.py",
        "    out: Array = here @ np.linalg.inv(inverse) @ np.swapaxes(here, 1, 2)",
        "    out: Array = here @ np.linalg.inv(4 * inverse) @ np.swapaxes(here, 1, 2)",
        (_SIGMA,),
    ),
    Mutant(
        "sigma: half of it in the table of the centreline",
        "gcar_deploy/output/tables.py",
        "branch.radius_mm, branch.sigma_mm, branch.confidence]",
        "branch.radius_mm, 0.5 * branch.sigma_mm, branch.confidence]",
        ("tests/output/test_tables.py",),
    ),
    Mutant(
        "rays: a point counts for its neighbour's ray",
        "gcar_deploy/predict/encoding.py",
        "np.unique(row * cols + col, return_inverse",
        "np.unique(row * cols + col // 2 * 2, return_inverse",
        ("tests/predict/test_encoding.py",),
    ),
    Mutant(
        "rays: a pixel belongs to the last vessel of its run, not the nearest",
        "gcar_deploy/tubes/pairing.py",
        "np.minimum.at(best, run, rank)",
        "best[run] = rank",
        (_MODEL,),
    ),
    Mutant(
        "views: pictures in the wrong order are not noticed",
        "gcar_deploy/pose/agreement.py",
        "    return check_order(ids, given, orders[i, j], kind_of(views), options.quality)",
        '    return [], ""',
        ("tests/hard/test_matrix.py::test_swapped_pictures_are_asked_for_by_name",),
    ),
    Mutant(
        "views: validate does not judge the poses",
        "gcar_deploy/pose/registration.py",
        "findings += check_poses(views, moves, options.quality)",
        "findings += []",
        ("tests/test_inspection.py::test_three_views_are_placed_as_run_places_them",),
    ),
    Mutant(
        "pictures: what is lost in the noise is a vessel",
        "gcar_deploy/imaging/extract.py",
        "if length < least_mm or too_faint:",
        "if length < least_mm:",
        ("tests/imaging/test_extract.py",),
    ),
    Mutant(
        "tree: branches run from their free end",
        "gcar_deploy/tree/rooted.py",
        "if far[b.start] > far[b.end]",
        "if far[b.start] < far[b.end]",
        ("tests/tree/test_rooted.py",),
    ),
    Mutant(
        "names: the ostium that anatomy names is not the inlet",
        "gcar_deploy/measure/inlet.py",
        "for wanted in (marked, blunt, named, free))",
        "for wanted in (marked, (), free))",
        ("tests/measure/test_inlet.py",),
    ),
    Mutant(
        "measures: worked out anew whenever they are asked for",
        "gcar_deploy/reconstruction.py",
        "@functools.cached_property\n    def measured",
        "@property\n    def measured",
        ("tests/measure/test_measured.py",),
    ),
    Mutant(
        "folders: --force takes whatever is in the way",
        "gcar_deploy/output/folder.py",
        "    if other is not None:\n        raise",
        "    if other == 0:\n        raise",
        ("tests/output/test_folder.py",),
    ),
    Mutant(
        "measures: what is undefined is 0",
        "gcar_deploy/plain.py",
        'reasons[path] = "not finite"\n        return None',
        "return 0.0",
        ("tests/output/test_files.py",),
    ),
    Mutant(
        "tubes: vessels exchanged in the view that they do not cross in",
        "gcar_deploy/tubes/exchange.py",
        "here[view], there[view] = there[view], here[view]",
        "here[1 - view], there[1 - view] = there[1 - view], here[1 - view]",
        ("tests/tubes/test_exchange.py",),
    ),
)  # fmt: skip

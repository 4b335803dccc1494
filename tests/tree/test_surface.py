import numpy as np
import pytest

from gcar_deploy.tree.surface import lumen_surface, stl_bytes
from gcar_deploy.tree.tree import empty_tree
from tests.tree.shapes import enclosed_mm3, fork, tube


def edge_counts(faces):
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    return np.unique(edges, axis=0, return_counts=True)[1]


@pytest.mark.parametrize("tree", [tube(radius=0.6), tube(radius=2.0, axis=(1, 2, 3)), fork()])
def test_watertight_and_outwards(tree):
    surface = lumen_surface(tree)
    assert (edge_counts(surface.faces) == 2).all()
    assert enclosed_mm3(surface) > 0
    assert np.isfinite(surface.vertices_mm).all()


def test_volume_and_place_of_a_tube():
    surface = lumen_surface(tube(length=30, radius=2), edge_mm=0.3)
    assert enclosed_mm3(surface) == pytest.approx(np.pi * 4 * 30 + 4 / 3 * np.pi * 8, rel=0.02)
    middle = np.abs(surface.vertices_mm[:, 2]) < 14
    r = np.linalg.norm(surface.vertices_mm[middle, :2], axis=1)
    np.testing.assert_allclose(r, 2.0, atol=0.03)


def test_stl_is_read_by_vtk(tmp_path):
    vtk = pytest.importorskip("vtk")
    surface = lumen_surface(fork())
    path = tmp_path / "surface.stl"
    path.write_bytes(stl_bytes(surface))
    reader = vtk.vtkSTLReader()
    reader.SetFileName(str(path))
    reader.Update()
    assert reader.GetOutput().GetNumberOfCells() == len(surface.faces)
    holes = vtk.vtkFeatureEdges()
    holes.SetInputConnection(reader.GetOutputPort())
    holes.FeatureEdgesOff()
    holes.ManifoldEdgesOff()
    holes.Update()
    assert holes.GetOutput().GetNumberOfCells() == 0


def test_no_tree_no_triangle():
    assert len(lumen_surface(empty_tree()).faces) == 0

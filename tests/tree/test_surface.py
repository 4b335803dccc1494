import numpy as np
import pytest
from scipy.spatial import cKDTree
from skimage.measure import marching_cubes

from gcar_deploy.tree.surface import (
    BLOCK,
    lumen_distance,
    lumen_lattice,
    lumen_surface,
    stl_bytes,
)
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


@pytest.mark.slow
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


@pytest.mark.parametrize("edge_mm", [0.3, 0.5])
def test_blocks_give_the_surface_of_the_whole_lattice(edge_mm):
    tree = fork()
    lattice = lumen_lattice(tree, edge_mm)
    assert max(lattice.shape) > 2 * BLOCK
    distance = lumen_distance(tree, lattice)
    distance[np.abs(distance) < 1e-3 * edge_mm] = 1e-3 * edge_mm
    index, faces, _, _ = marching_cubes(distance, 0.0, gradient_direction="descent")
    surface = lumen_surface(tree, edge_mm)
    assert (len(surface.vertices_mm), len(surface.faces)) == (len(index), len(faces))
    off, _ = cKDTree(lattice.index2world(index)).query(surface.vertices_mm)
    assert off.max() < 1e-4
    assert (edge_counts(surface.faces) == 2).all()

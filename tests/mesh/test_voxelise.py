import numpy as np
import pytest

from bodies import box_cells
from palpate.errors import GeometryError
from palpate.images.label_image import VoxelGrid
from palpate.images.tissue import Role, Tissue
from palpate.mesh.space import lagrange_space
from palpate.mesh.tet_mesh import FACES, OUTER, TetMesh
from palpate.mesh.voxelise import BRICKS, DeformedFaces, voxelise

TISSUES = (
    Tissue("ball", Role.ESTIMATE, (1,)),
    Tissue("cavity", Role.DRIVER, (2,)),
    Tissue("rest", Role.KNOWN, (), youngs_modulus_kpa=10.0),
)


def ball_and_cavity(cells=8, size=16.0):
    """A cube of Kuhn tetrahedra around the origin: a stepped ball on one side, a hollow on the other."""
    nodes, tets = box_cells((cells,) * 3, (size,) * 3)
    nodes = nodes - size / 2 + 0.013 * np.array([1.0, 0.7, -0.4])  # off the voxel grid
    edges = nodes[tets][:, 1:] - nodes[tets][:, :1]
    flipped = np.linalg.det(edges) < 0
    tets[flipped] = tets[flipped][:, [0, 2, 1, 3]]
    centre = nodes[tets].mean(axis=1)
    region = np.full(len(tets), 2)
    region[np.linalg.norm(centre - [-3.0, 0.0, 0.0], axis=1) < 4.0] = 0
    region[np.linalg.norm(centre - [4.0, 1.0, 0.0], axis=1) < 2.8] = 1
    return hollowed(nodes, tets, region)


def hollowed(nodes, tets, region):
    faces, owner = tets[:, FACES].reshape(-1, 3), np.repeat(region, 4)
    _, inverse, count = np.unique(np.sort(faces, axis=1), axis=0, return_inverse=True, return_counts=True)
    touches_hollow = np.bincount(inverse.ravel(), weights=owner == 1)[inverse.ravel()] > 0
    single = count[inverse.ravel()] == 1
    keep = (owner != 1) & (single | touches_hollow)
    beyond = np.where(single[keep], OUTER, 1)
    return TetMesh(nodes, tets[region != 1], region[region != 1], faces[keep], beyond, TISSUES)


def grid(shape=(40, 44, 38), spacing=0.5, origin=(-10.0, -11.0, -9.4)):
    affine = np.diag([spacing, spacing, spacing, 1.0])
    affine[:3, 3] = origin
    return VoxelGrid(shape, affine)


def wave(points):
    return 0.3 * np.sin(points[:, [1, 2, 0]] / 3.0)


@pytest.mark.parametrize("element", ["P1", "P2"])
def test_every_voxel_is_of_the_tissue_whose_tetrahedron_holds_it(element):
    mesh = ball_and_cavity()
    space = lagrange_space(mesh, element)
    tissue = voxelise(space, np.zeros_like(space.points), grid())
    rng = np.random.default_rng(3)
    chosen = rng.choice(len(mesh.tets), 400, replace=False)
    index = np.round(grid().index(mesh.nodes[mesh.tets[chosen]].mean(axis=1)))
    inverse = np.linalg.inv(
        np.swapaxes(mesh.nodes[mesh.tets[chosen]][:, 1:] - mesh.nodes[mesh.tets[chosen]][:, :1], 1, 2)
    )
    local = np.einsum("nij,nj->ni", inverse, grid().world(index) - mesh.nodes[mesh.tets[chosen, 0]])
    inside = (local > 1e-6).all(axis=1) & (local.sum(axis=1) < 1 - 1e-6)
    assert inside.sum() > 50
    found = tissue[tuple(index.astype(int).T)]
    assert (found == mesh.region[chosen])[inside].all()


def test_volumes_are_those_of_the_deformed_mesh_within_sampling_error():
    mesh = ball_and_cavity()
    space = lagrange_space(mesh, "P1")
    displacement = wave(space.points)
    tissue = voxelise(space, displacement, grid(shape=(80, 88, 76), spacing=0.25))
    moved = (mesh.nodes + displacement)[mesh.tets]
    volumes = np.linalg.det(moved[:, 1:] - moved[:, :1]) / 6.0
    ball = volumes[mesh.region == 0].sum()
    assert np.count_nonzero(tissue == 0) * 0.25**3 == pytest.approx(ball, rel=0.01)
    cavity = 16.0**3 - ball - volumes[mesh.region == 2].sum()
    assert np.count_nonzero(tissue == 1) * 0.25**3 == pytest.approx(cavity, rel=0.05)


def test_a_translation_by_whole_voxels_shifts_the_image_exactly():
    space = lagrange_space(ball_and_cavity(), "P2")
    rest = voxelise(space, wave(space.points), grid())
    moved = voxelise(space, wave(space.points) + 0.5 * np.array([3.0, -2.0, 4.0]), grid())
    assert np.array_equal(np.roll(rest, (3, -2, 4), axis=(0, 1, 2))[5:-5, 5:-5, 5:-5], moved[5:-5, 5:-5, 5:-5])


def test_touching_regions_leave_no_gap_and_no_overlap_even_on_voxel_centres():
    mesh = ball_and_cavity()
    aligned = TetMesh(np.round(mesh.nodes), mesh.tets, mesh.region, mesh.boundary, mesh.beyond, TISSUES)
    space = lagrange_space(aligned, "P1")
    tissue = voxelise(space, np.zeros_like(space.points), grid(shape=(17, 17, 17), spacing=1.0, origin=(-8, -8, -8)))
    ball = aligned.volumes[aligned.region == 0].sum()
    assert np.count_nonzero(tissue == 0) == pytest.approx(ball, rel=0.15)
    inside = tissue[1:-1, 1:-1, 1:-1]
    assert set(np.unique(inside)) == {0, 1, 2}


@pytest.mark.parametrize("spacing", [0.5, 2.3])
def test_a_voxel_has_the_same_tissue_in_whatever_brick_it_lies_in_holes_and_outside_of_the_mesh(spacing):
    """An image that begins some voxels further on has its bricks elsewhere; one voxel thin it has none to speak of."""
    space = lagrange_space(ball_and_cavity(), "P2")
    affine = np.array([[0.96, -0.28, 0.0], [0.28, 0.96, 0.0], [0.0, 0.0, 1.0]]) @ np.diag(
        [spacing, spacing, 1.4 * spacing]
    )
    wide = VoxelGrid((47, 41, 29), np.block([[affine, np.full((3, 1), -12.0)], [np.zeros((1, 3)), 1.0]]))
    bricks = voxelise(space, wave(space.points), wide)
    assert {1, 2} <= set(np.unique(bricks))

    def part(*of: slice) -> VoxelGrid:
        """The grid of some of the voxels."""
        start = np.array([each.start or 0 for each in of])
        origin = wide.affine[:3, :3] @ start + wide.affine[:3, 3]
        affine = np.block([[wide.affine[:3, :3], origin[:, None]], [np.array([[0.0, 0.0, 0.0, 1.0]])]])
        shape = tuple(len(range(n)[each]) for n, each in zip(wide.shape, of, strict=True))
        return VoxelGrid(shape, affine)

    slabs = [(slice(k, k + 1), slice(None), slice(None)) for k in (13, 21)]
    starts = [(size - a, size - b, size - c) for size in BRICKS for a, b, c in ((1, 2, 3), (3, 1, 2), (2, 3, 1))]
    for of in [tuple(slice(k, None) for k in start) for start in starts] + slabs:
        assert np.array_equal(voxelise(space, wave(space.points), part(*of)), bricks[of])


def test_around_a_body_without_a_hollow_every_voxel_is_of_its_outer_tissue():
    """Nothing else lies behind any face."""
    mesh = ball_and_cavity()
    region, beyond = np.full(len(mesh.tets), 2), np.full(len(mesh.beyond), OUTER)
    space = lagrange_space(TetMesh(mesh.nodes, mesh.tets, region, mesh.boundary, beyond, TISSUES), "P1")
    assert np.all(voxelise(space, np.zeros_like(space.points), grid()) == 2)


def test_faces_that_are_laid_over_several_grids_give_what_each_gives_alone():
    space = lagrange_space(ball_and_cavity(), "P2")
    faces = DeformedFaces.of(space, wave(space.points))
    for own in (grid(), grid(shape=(17, 17, 17), spacing=1.0, origin=(-8, -8, -8))):
        assert np.array_equal(faces.on(own), voxelise(space, wave(space.points), own))


def test_any_orientation_of_the_voxel_axes_gives_the_same_tissues():
    space = lagrange_space(ball_and_cavity(), "P2")
    straight = voxelise(space, wave(space.points), grid())
    affine = grid().affine @ np.array([[0, 0, -1, 39], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1.0]])
    turned = voxelise(space, wave(space.points), VoxelGrid((44, 38, 40), affine))
    back = np.transpose(turned, (2, 0, 1))[::-1]
    assert np.mean(back != straight) < 1e-4  # voxels within a tie of a face


def test_quadratic_faces_are_followed_better_by_finer_subdivision():
    space = lagrange_space(ball_and_cavity(4), "P2")
    bubble = np.zeros_like(space.points)
    bubble[len(space.mesh.nodes) :] = 0.3 * np.sin(space.points[len(space.mesh.nodes) :])
    images = [voxelise(space, bubble, grid(), subdivisions=s) for s in (0, 1, 2, 4)]
    wrong = [np.count_nonzero(image != images[-1]) for image in images[:-1]]
    assert wrong[0] > 2 * wrong[1] > 4 * wrong[2]


def test_a_warp_moves_the_surfaces():
    space = lagrange_space(ball_and_cavity(), "P2")
    still, shift = np.zeros_like(space.points), np.array([0.5, 0.0, 0.0])
    warped = voxelise(space, still, grid(), warp=lambda points: points + shift)
    assert np.array_equal(warped, voxelise(space, still + shift, grid()))


def test_surfaces_that_cross_are_refused():
    space = lagrange_space(ball_and_cavity(), "P1")
    folded = np.zeros_like(space.points)
    folded[:, 0] = -3.0 * space.points[:, 0] * (np.linalg.norm(space.points, axis=1) < 5.0)
    with pytest.raises(GeometryError, match="cross each other"):
        voxelise(space, folded, grid())

"""Conforming tetrahedra of several tissues, their surfaces, spaces and voxels."""

from palpate.mesh.anatomy import Anatomy, Box, LevelSet, anatomy_of, domain_box, margin_box
from palpate.mesh.constraint import Constraint
from palpate.mesh.locate import located, point_interpolation
from palpate.mesh.quality import check_mesh
from palpate.mesh.space import LagrangeSpace, lagrange_space, triangle_shape
from palpate.mesh.surface import tissue_surface, triangle_normals, vertex_normals
from palpate.mesh.tet_mesh import FACES, OUTER, TetMesh
from palpate.mesh.tetrahedralise import SizeField, boundary_of, tetrahedralise

__all__ = [
    "FACES",
    "OUTER",
    "Anatomy",
    "Box",
    "Constraint",
    "LagrangeSpace",
    "LevelSet",
    "SizeField",
    "TetMesh",
    "anatomy_of",
    "boundary_of",
    "check_mesh",
    "domain_box",
    "lagrange_space",
    "located",
    "margin_box",
    "point_interpolation",
    "tetrahedralise",
    "tissue_surface",
    "triangle_normals",
    "triangle_shape",
    "vertex_normals",
]

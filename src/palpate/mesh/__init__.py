"""Conforming tetrahedra of several tissues, their surfaces, spaces and voxels."""

from palpate.mesh.anatomy import Anatomy as Anatomy
from palpate.mesh.anatomy import Box as Box
from palpate.mesh.anatomy import LevelSet as LevelSet
from palpate.mesh.anatomy import anatomy_of as anatomy_of
from palpate.mesh.anatomy import domain_box as domain_box
from palpate.mesh.anatomy import margin_box as margin_box
from palpate.mesh.locate import located as located
from palpate.mesh.locate import modulus_image as modulus_image
from palpate.mesh.locate import point_interpolation as point_interpolation
from palpate.mesh.quality import check_mesh as check_mesh
from palpate.mesh.space import Constraint as Constraint
from palpate.mesh.space import LagrangeSpace as LagrangeSpace
from palpate.mesh.space import lagrange_space as lagrange_space
from palpate.mesh.space import shape_functions as shape_functions
from palpate.mesh.surface import tissue_surface as tissue_surface
from palpate.mesh.surface import triangle_normals as triangle_normals
from palpate.mesh.surface import vertex_normals as vertex_normals
from palpate.mesh.tet_mesh import FACES as FACES
from palpate.mesh.tet_mesh import OUTER as OUTER
from palpate.mesh.tet_mesh import TetMesh as TetMesh
from palpate.mesh.tetrahedralise import SizeField as SizeField
from palpate.mesh.tetrahedralise import boundary_of as boundary_of
from palpate.mesh.tetrahedralise import outer_faces as outer_faces
from palpate.mesh.tetrahedralise import tetrahedralise as tetrahedralise

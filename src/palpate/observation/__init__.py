"""What the images say of the deformed model: driver modes, targets, surface misfit."""

from palpate.observation.contract import DataFile as DataFile
from palpate.observation.contract import ImagedBody as ImagedBody
from palpate.observation.contract import Observation as Observation
from palpate.observation.displacement_field import DisplacementField as DisplacementField
from palpate.observation.landmarks import Landmarks as Landmarks
from palpate.observation.noise_model import SEGMENTATION_NOISE as SEGMENTATION_NOISE
from palpate.observation.noise_model import FitResponse as FitResponse
from palpate.observation.noise_model import NoiseModel as NoiseModel
from palpate.observation.noise_model import correlation as correlation
from palpate.observation.noise_model import fit_noise_model as fit_noise_model
from palpate.observation.observed_surface import ObservedSurface as ObservedSurface
from palpate.observation.observed_surface import observed_surface as observed_surface
from palpate.observation.point_displacement import PointDisplacement as PointDisplacement
from palpate.observation.point_table import PointTable as PointTable
from palpate.observation.point_table import stated_sd as stated_sd
from palpate.observation.prescribed_motion import prescribed_motion as prescribed_motion
from palpate.observation.registry import observations as observations
from palpate.observation.surface_distance import SurfaceDistance as SurfaceDistance
from palpate.observation.surface_distance import surface_distance as surface_distance
from palpate.observation.surface_distance import surface_distances as surface_distances
from palpate.observation.target import SurfaceTarget as SurfaceTarget
from palpate.observation.target import target_from as target_from

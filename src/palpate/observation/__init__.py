"""What the images say of the deformed model: driver modes, targets, surface misfit."""

from palpate.observation.contract import DataFile, ImagedBody, Observation
from palpate.observation.displacement_field import DisplacementField
from palpate.observation.landmarks import Landmarks
from palpate.observation.measured_points import PointTable
from palpate.observation.noise_model import SEGMENTATION_NOISE, FitResponse, NoiseModel, correlation, fit_noise_model
from palpate.observation.observed_surface import ObservedSurface, observed_surface
from palpate.observation.point_displacement import PointDisplacement
from palpate.observation.prescribed_motion import prescribed_motion
from palpate.observation.registry import observations
from palpate.observation.surface_distance import SurfaceDistance, surface_distance, surface_distances
from palpate.observation.target import SurfaceTarget, target_from

__all__ = [
    "SEGMENTATION_NOISE",
    "DataFile",
    "DisplacementField",
    "FitResponse",
    "ImagedBody",
    "Landmarks",
    "NoiseModel",
    "Observation",
    "ObservedSurface",
    "PointDisplacement",
    "PointTable",
    "SurfaceDistance",
    "SurfaceTarget",
    "correlation",
    "fit_noise_model",
    "observations",
    "observed_surface",
    "prescribed_motion",
    "surface_distance",
    "surface_distances",
    "target_from",
]

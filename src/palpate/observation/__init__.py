"""What the images say of the deformed model: driver modes, targets, surface misfit."""

from palpate.observation.contract import ImagedBody, Observation
from palpate.observation.noise_model import SEGMENTATION_NOISE, FitResponse, NoiseModel, fit_noise_model
from palpate.observation.observed_surface import ObservedSurface, observed_surface
from palpate.observation.prescribed_motion import prescribed_motion
from palpate.observation.registry import observations
from palpate.observation.surface_distance import SurfaceDistance, surface_distance, surface_distances
from palpate.observation.target import SurfaceTarget, target_from

__all__ = [
    "SEGMENTATION_NOISE",
    "FitResponse",
    "ImagedBody",
    "NoiseModel",
    "Observation",
    "ObservedSurface",
    "SurfaceDistance",
    "SurfaceTarget",
    "fit_noise_model",
    "observations",
    "observed_surface",
    "prescribed_motion",
    "surface_distance",
    "surface_distances",
    "target_from",
]

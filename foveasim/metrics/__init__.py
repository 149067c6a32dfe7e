"""
Image-quality metrics of sensors and pictures.

Photon transfer, EMVA 1288 parameters, resolution, aliasing, optical flow, and image similarity.
"""

from __future__ import annotations

from foveasim._core.calls import publish
from foveasim.metrics import shots  # noqa: F401 -- registers the metrics of shots
from foveasim.metrics.aliasing import AliasingSpectrum, SamplingSpectrum, aliasing_spectrum, sampling_spectrum
from foveasim.metrics.emva import Emva1288, emva1288
from foveasim.metrics.emva_intervals import EmvaIntervals
from foveasim.metrics.flow import FlowBound, FlowEstimate, estimate_flow, flow_bound, site_gradients_e_per_um
from foveasim.metrics.photon_transfer import PhotonTransfer, draw_frames, photon_transfer, predicted_photon_transfer
from foveasim.metrics.pixel_mtf import polygon_mtf, polygon_otf, wave_vectors_per_mm
from foveasim.metrics.quality import psnr_db, ssim
from foveasim.metrics.registry import METRICS, Metric, MetricInfo, metric_info
from foveasim.metrics.sampling import (
    EccentricityTable,
    neighbour_spacing_um,
    nyquist_per_mm,
    nyquist_vs_eccentricity,
)
from foveasim.metrics.slanted_edge import EdgeMtf, slanted_edge_mtf
from foveasim.metrics.snr import (
    SnrTable,
    measured_snr_by_class,
    relative_exposure_at_snr_fraction,
    size_classes_um,
    snr_by_class,
)

__all__ = [
    "METRICS",
    "AliasingSpectrum",
    "EccentricityTable",
    "EdgeMtf",
    "Emva1288",
    "EmvaIntervals",
    "FlowBound",
    "FlowEstimate",
    "Metric",
    "MetricInfo",
    "PhotonTransfer",
    "SamplingSpectrum",
    "SnrTable",
    "aliasing_spectrum",
    "draw_frames",
    "emva1288",
    "estimate_flow",
    "flow_bound",
    "measured_snr_by_class",
    "metric_info",
    "neighbour_spacing_um",
    "nyquist_per_mm",
    "nyquist_vs_eccentricity",
    "photon_transfer",
    "polygon_mtf",
    "polygon_otf",
    "predicted_photon_transfer",
    "psnr_db",
    "relative_exposure_at_snr_fraction",
    "sampling_spectrum",
    "site_gradients_e_per_um",
    "size_classes_um",
    "slanted_edge_mtf",
    "snr_by_class",
    "ssim",
    "wave_vectors_per_mm",
]

publish(__name__)

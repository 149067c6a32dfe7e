"""What a sensor is worth, in numbers: photon transfer, and the parameters of EMVA 1288."""

from __future__ import annotations

from foveasim.metrics.emva import Emva1288, emva1288
from foveasim.metrics.photon_transfer import PhotonTransfer, draw_frames, photon_transfer, predicted_photon_transfer

__all__ = ["Emva1288", "PhotonTransfer", "draw_frames", "emva1288", "photon_transfer", "predicted_photon_transfer"]

"""What a sensor and its pictures are worth, in numbers: photon transfer, EMVA 1288, PSNR and similarity."""

from __future__ import annotations

from foveasim.metrics.emva import Emva1288, emva1288
from foveasim.metrics.photon_transfer import PhotonTransfer, draw_frames, photon_transfer, predicted_photon_transfer
from foveasim.metrics.quality import psnr_db, ssim

__all__ = [
    "Emva1288",
    "PhotonTransfer",
    "draw_frames",
    "emva1288",
    "photon_transfer",
    "predicted_photon_transfer",
    "psnr_db",
    "ssim",
]

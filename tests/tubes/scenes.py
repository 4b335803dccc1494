"""Made trees seen in two views, as the refiners take them."""

import dataclasses

import numpy as np
from skimage.morphology import skeletonize

from gcar_deploy.geometry.carm import CArm
from gcar_deploy.imaging.angiogram import VesselImage
from gcar_deploy.imaging.mask_path import mask_path
from tests.tubes.oracle import path_lengths


def carm(primary, secondary, size=256, spacing=0.5):
    return CArm(
        primary_angle_deg=primary, secondary_angle_deg=secondary, sod_mm=765, sdd_mm=1100,
        rows=size, columns=size, pixel_spacing_mm=(spacing, spacing),
    )  # fmt: skip


def two_views(size=256, spacing=0.5):
    return [carm(-30, -20, size, spacing), carm(45, 25, size, spacing)]


def vessel_image(view, path, calibrated=True, name="1"):
    path = np.asarray(path, dtype=np.float32)
    return VesselImage(
        view_id=name,
        carm=view,
        path_mm=path,
        path_error=0.0 if calibrated else 0.25,
        mask=path > 0.1,
        skeleton=np.zeros(path.shape, bool),
        valid=np.ones(path.shape, bool),
        kind="path_length" if calibrated else "attenuation",
    )


def seen(tree, carms, calibrated=True, gain=1.0):
    """Pictures of a tree by the oracle, which shares nothing with the tube model."""
    return [
        vessel_image(view, gain * path_lengths(tree, view), calibrated, str(k + 1))
        for k, view in enumerate(carms)
    ]


def seen_as_masks(tree, carms):
    """Masks of the same pictures, with the chords that their widths tell."""
    return [
        dataclasses.replace(
            view,
            path_mm=mask_path(view.mask, view.carm.pixel_at_isocenter_mm),
            path_error=0.3,
            skeleton=skeletonize(view.mask),
            kind="mask",
        )
        for view in seen(tree, carms)
    ]

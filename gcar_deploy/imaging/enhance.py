"""From grey values to ridge response: logarithm, flattening, vesselness."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import cv2
import numpy as np

from gcar_deploy.imaging import coarse
from gcar_deploy.imaging.collimator import MOST_SHUT, collimator
from gcar_deploy.types import Image, Mask

#: Gaussian widths of the ridge filter: vessel diameters of some 1 to 7 mm
RIDGE_SIGMA_MM = (0.75, 1.05, 1.5, 2.1)
#: the ridge must stand above both sides at this many sigma (a step edge has only one)
SIDE_GAP_SIGMAS = 2.5
#: response times sigma^power: below 0 a narrow explanation wins over a wide one
SCALE_POWER = -0.5
#: what varies more slowly than this is background to the ridge filter
FLATTEN_SIGMA_MM = 10.0
#: of pixels up to this size at the isocentre polarity is told as well as of smaller ones, mm
POLARITY_PIXEL_MM = 0.5
#: of polarity, a ridge stands out that is so many times as strong as this percentile of all pixels
#: in the sign that shows less; that share of it is added to what stands out in either
STANDING_OUT, USUAL_PERCENT, LEAST_SHARE = 3.0, 90.0, 0.02
#: grey level, as a share of the white level, added before the logarithm
LOG_OFFSET = 0.08
#: ... and where paths are read from contrast: the window of a display takes the darkest grey value
#: from every pixel. Chosen on generated pictures of five displays, from linear to logarithmic: 0.1
#: to 0.4 do alike, and no better is told by widths or chords, which clutter spoils
DISPLAY_OFFSET = 0.2
#: filled-in background: margin left out round the vessels, and width of the fill (a far wider one
#: takes over where nothing is near)
MARGIN_MM, FILL_SIGMA_MM = 1.0, 2.5


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Ridges:
    """Multi-scale response to bright lines.

    Attributes
    ----------
    response : (rows, cols) float32, in units of the picture, times sigma^power
    sigma_px : (rows, cols) float32, Gaussian width at which the response was largest
    """

    response: Image
    sigma_px: Image


def absorbance(pixels: Image) -> Image:
    """(rows, cols) -log(grey / white + ``LOG_OFFSET``): what absorbs more is brighter.

    White is the 99.5th percentile. The offset keeps black finite and halves the gain where a
    display curve has squeezed the dark end; it is a compromise between a linear detector and
    a picture whose logarithm was already taken.
    """
    white = max(float(np.percentile(pixels, 99.5)), 1e-12)
    return -np.log(np.clip(pixels, 0, None) / white + LOG_OFFSET, dtype=np.float32)


def searched(pictures: Mapping[str, Image]) -> Image:
    """Return the one of ``bright_vessels`` to look for vessels in: the first, or named."""
    return pictures.get("search", next(iter(pictures.values())))


def fill_holes(picture: Image, holes: Mask) -> Image:
    """Give each pixel of ``holes`` the value of the nearest pixel outside."""
    if not holes.any() or holes.all():
        return picture
    _, label = cv2.distanceTransformWithLabels(
        holes.astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    table = np.zeros(int(label.max()) + 1, picture.dtype)
    table[label[~holes]] = picture[~holes]
    return np.where(holes, table[label], picture)


def flatten(picture: Image, sigma_px: float) -> Image:
    """Take away what varies more slowly than a Gaussian of ``sigma_px``."""
    return picture - wide_blur(picture, sigma_px)


def wide_blur(picture: Image, sigma_px: float) -> Image:
    """Blur by a Gaussian that is wide: on a coarser picture, where that does not show."""
    factor = max(1, int(sigma_px // 4))
    if factor == 1:
        near = cv2.GaussianBlur(picture, (0, 0), sigma_px, borderType=cv2.BORDER_REPLICATE)
        return np.asarray(near, dtype=np.float32)
    rows, columns = picture.shape
    small = cv2.GaussianBlur(
        coarse.smaller(picture, factor), (0, 0), sigma_px / factor, borderType=cv2.BORDER_REPLICATE
    )
    small = cv2.resize(small, (columns, rows), interpolation=cv2.INTER_LINEAR)
    return np.asarray(small, dtype=np.float32)


def background(picture: Image, vessel: Mask, pixel_mm: float) -> Image:
    """Fill the vessels in from their surroundings by normalised convolution.

    Parameters
    ----------
    picture : (rows, cols) float32
    vessel : (rows, cols) bool
    pixel_mm : float, pixel size at the isocentre
    """
    sigma_px = FILL_SIGMA_MM / pixel_mm
    reach = 2 * max(1, round(MARGIN_MM / pixel_mm)) + 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (reach, reach))
    weight = 1.0 - cv2.dilate(vessel.astype(np.uint8), disc).astype(np.float32)
    near, near_weight = _blurred_pair(picture, weight, sigma_px)
    far, far_weight = _blurred_pair(picture, weight, 4 * sigma_px)
    trust = np.float32(0.01)
    total = near + trust * far / np.maximum(far_weight, np.float32(1e-6))
    return np.asarray(total / (near_weight + trust), dtype=np.float32)


def rise(picture: Image, holes: Mask, vessel: Mask, pixel_mm: float) -> Image:
    """(rows, cols) float32, >= 0: what stands out of the background behind vessels.

    Parameters
    ----------
    picture : (rows, cols) float32, vessels bright
    holes : (rows, cols) bool, pixels without picture
    vessel : (rows, cols) bool, all that may be vessel: no background
    pixel_mm : float, pixel size at the isocentre
    """
    filled = fill_holes(picture, holes)
    return np.clip(filled - background(filled, vessel, pixel_mm), 0, None)


def _blurred_pair(picture: Image, weight: Image, sigma_px: float) -> tuple[Image, Image]:
    return wide_blur(picture * weight, sigma_px), wide_blur(weight, sigma_px)


def curvature(picture: Image, sigma_px: float) -> tuple[Image, Image, Image]:
    """Strongest negative curvature of a blurred picture.

    Returns
    -------
    smooth : (rows, cols) float32, blurred by a Gaussian of ``sigma_px``
    strongest : (rows, cols) float32, smaller eigenvalue of its Hessian, units per pixel^2
    normal : (rows, cols) float32, direction of that eigenvector, radians from the columns' axis
    """
    smooth = cv2.GaussianBlur(picture, (0, 0), sigma_px, borderType=cv2.BORDER_REPLICATE)
    xx = cv2.Sobel(smooth, cv2.CV_32F, 2, 0, ksize=3, scale=0.25)
    yy = cv2.Sobel(smooth, cv2.CV_32F, 0, 2, ksize=3, scale=0.25)
    xy = cv2.Sobel(smooth, cv2.CV_32F, 1, 1, ksize=3, scale=0.25)
    half_gap = np.hypot(0.5 * (xx - yy), xy)
    angle = 0.5 * np.arctan2(2 * xy, xx - yy) + np.float32(np.pi / 2)
    return (
        np.asarray(smooth, dtype=np.float32),
        np.asarray(0.5 * (xx + yy) - half_gap, dtype=np.float32),
        np.asarray(angle, dtype=np.float32),
    )


def ridge_response(picture: Image, sigma_px: float, gap_sigmas: float) -> Image:
    """Response of one scale to bright lines.

    Geometric mean of the Hessian's strongest negative curvature, -sigma^2 lambda_1 (Frangi et
    al. 1998; its peak over sigma is at the line's own width), and of the step down to the
    *higher* of the two sides, ``gap_sigmas`` sigma away along the normal. An edge has
    curvature but no second side, a blob in noise little of either.

    Parameters
    ----------
    picture : (rows, cols) float32
    sigma_px : float
    gap_sigmas : float

    Returns
    -------
    (rows, cols) float32, units of the picture, >= 0
    """
    smooth, strongest, angle = curvature(picture, sigma_px)
    step = np.float32(gap_sigmas * sigma_px)
    dx, dy = step * np.cos(angle), step * np.sin(angle)
    row, column = np.indices(picture.shape, dtype=np.float32)
    sides = [
        cv2.remap(
            smooth, column + s * dx, row + s * dy, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
        for s in (np.float32(1), np.float32(-1))
    ]
    drop = np.clip(smooth - np.maximum(*sides), 0, None)
    return np.sqrt(drop * np.clip(-strongest, 0, None)) * np.float32(sigma_px)


def ridges(picture: Image, pixel_mm: float) -> Ridges:
    """Largest response over ``RIDGE_SIGMA_MM``; ``picture`` has bright vessels."""
    response = np.zeros_like(picture)
    best = np.ones_like(picture)
    for sigma in sorted({max(1.0, mm / pixel_mm) for mm in RIDGE_SIGMA_MM}):
        # relative to the smallest scale, so that units stay those of the picture
        weight = (sigma * pixel_mm / RIDGE_SIGMA_MM[0]) ** SCALE_POWER
        one = np.float32(weight) * ridge_response(picture, sigma, SIDE_GAP_SIGMAS)
        larger = one > response
        response[larger] = one[larger]
        best[larger] = sigma
    return Ridges(response=response, sigma_px=best)


def _coarser(pixels: Image, pixel_mm: float) -> tuple[Image, float]:
    """Average blocks of pixels, up to ``POLARITY_PIXEL_MM`` wide; return their size, too."""
    factor = int(POLARITY_PIXEL_MM / pixel_mm)
    if factor < 2:
        return pixels, pixel_mm
    return coarse.smaller(pixels, factor), factor * pixel_mm


def darkness(pixels: Image, pixel_mm: float) -> float:
    """Compare the ridges of the picture with those of its negative.

    What stands out of either counts, so that neither noise nor the share of the picture that is
    vessel says much.

    Returns
    -------
    float
        Log of the ratio of the two strengths: above 0 where dark lines are the stronger ones.
    """
    pixels, pixel_mm = _coarser(pixels, pixel_mm)
    holes = collimator(pixels)
    # A negative has bright shutters, whose rim would be the strongest line of all.
    shut = holes | collimator(pixels, negative=True)
    if shut.mean() <= MOST_SHUT:
        holes = shut
    flat = flatten(fill_holes(pixels, holes), FLATTEN_SIGMA_MM / pixel_mm)
    found = [ridges(picture, pixel_mm).response[~holes] for picture in (-flat, flat)]
    usual = min(float(np.percentile(response, USUAL_PERCENT)) for response in found)
    dark, bright = (
        float(np.maximum(response - STANDING_OUT * usual, 0).mean()) + LEAST_SHARE * usual + 1e-12
        for response in found
    )
    return float(np.log(dark / bright))

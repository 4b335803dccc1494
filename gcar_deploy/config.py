"""Options of every stage as frozen values; each default is written here and nowhere else."""

from __future__ import annotations

import dataclasses
from typing import TypeAlias

#: (col, row) of one point in each view, None where it is not seen
Landmark: TypeAlias = "tuple[tuple[float, float] | None, ...]"


@dataclasses.dataclass(frozen=True, kw_only=True)
class PictureLimits:
    """What a picture file may be before any decoder sees it."""

    max_bytes: int = 32 * 2**20
    #: pixels; each side of the picture
    min_side: int = 16
    max_side: int = 4096


@dataclasses.dataclass(frozen=True, kw_only=True)
class DicomLimits:
    """What a DICOM run may be before any of its pixels is decoded."""

    max_bytes: int = 512 * 2**20
    #: pixels; each side of a frame
    min_side: int = 16
    max_side: int = 4096
    max_frames: int = 2000
    #: of all frames together
    max_pixels: int = 2**30


@dataclasses.dataclass(frozen=True, kw_only=True)
class DicomOptions:
    """From a DICOM run to one picture with its geometry."""

    limits: DicomLimits = dataclasses.field(default_factory=DicomLimits)
    #: frame of each run, counted from 1, None to choose; one entry holds for all runs
    frames: tuple[int | None, ...] = (None,)
    #: for files that do not say it: pixel spacing at the detector, source to isocentre, mm
    pixel_spacing_mm: float | None = None
    sod_mm: float | None = None
    #: frames filled to this share of the best are compared by their stillness
    filled_share: float = 0.9
    #: a frame named by the file but filled less than this share of the best is worth a word
    least_filled_share: float = 0.5
    #: tilt of the detector against the beam: said above the first, refused above the second
    good_tilt_deg: float = 0.1
    max_tilt_deg: float = 1.0
    #: share by which SDD / SOD may differ from the file's own magnification factor
    magnification_share: float = 0.02


@dataclasses.dataclass(frozen=True, kw_only=True)
class ModelLimits:
    """What a model file may be before ONNX Runtime sees it."""

    max_bytes: int = 64 * 2**20
    #: of the spec beside it, and of the golden input and output
    max_spec_bytes: int = 64 * 2**10
    max_golden_bytes: int = 8 * 2**20
    max_nodes: int = 20_000
    #: fields of the file in all (a node has some ten)
    max_fields: int = 1_000_000
    #: weights and constants in all
    max_elements: int = 2**25
    max_opset: int = 30
    #: largest relative and absolute difference from the golden output
    golden_rtol: float = 1e-3
    golden_atol: float = 1e-4


@dataclasses.dataclass(frozen=True, kw_only=True)
class ImagingOptions:
    """From a picture to vessel mask, skeleton and path length. Millimetres at the isocentre."""

    limits: PictureLimits = dataclasses.field(default_factory=PictureLimits)
    #: who finds vessels in grey values: ``classic``, ``net``, or ``auto`` (the network is asked
    #: where the classical method finds none)
    segmenter: str = "classic"
    #: hysteresis on the network's probability
    net_low: float = 0.4
    net_high: float = 0.7
    #: path-length pictures: vessel where the ray's mean path exceeds this share of a pixel's
    #: edge p. A vessel of diameter D gives (pi/4) D^2 / p, so D >= 0.36 p is kept; less drowns
    #: in the sampling of the picture itself.
    path_threshold_pixels: float = 0.1
    #: vessels are looked for at this pixel size (coarser pictures keep their own)
    work_pixel_mm: float = 0.5
    #: Gaussian widths of the ridge filter: vessel diameters of some 1 to 7 mm
    ridge_sigma_mm: tuple[float, ...] = (0.75, 1.05, 1.5, 2.1)
    #: the ridge must stand above both sides at this many sigma (a step edge has only one)
    side_gap_sigmas: float = 2.5
    #: response times sigma^power: below 0 a narrow explanation wins over a wide one
    scale_power: float = -0.5
    #: what varies more slowly than this is background to the ridge filter
    flatten_sigma_mm: float = 10.0
    #: grey level, as a share of the white level, added before the logarithm
    log_offset: float = 0.08
    #: hysteresis, as shares of the 99th percentile of the response
    low_share: float = 0.3
    high_share: float = 0.6
    #: connected parts with less than this share of the strongest part's summed response go
    part_share: float = 0.08
    #: a side branch shorter than this is a spur; an end weaker than this share goes as well
    spur_mm: float = 7.5
    weak_share: float = 0.4
    #: a straight line as long as this share of the shorter side is a wire or an edge
    straight_share: float = 0.6
    #: rim of the mask: this many noise deviations, but within these shares of the peak
    rim_noise: float = 9.0
    rim_low: float = 0.15
    rim_high: float = 0.65
    #: farthest rim, in units of the ridge filter's sigma
    reach_sigmas: float = 1.6
    #: filled-in background: margin left round the vessels, and width of the fill
    margin_mm: float = 1.0
    fill_sigma_mm: float = 2.5
    #: less skeleton than this, or a weaker peak in noise deviations, is no vessel
    min_length_mm: float = 25.0
    min_contrast: float = 6.0
    #: and the peak, as a share of the white level, must be seen at all
    min_peak: float = 0.03


@dataclasses.dataclass(frozen=True, kw_only=True)
class CandidateOptions:
    """The sparse set of points that every view sees as vessel."""

    #: a lattice point is kept where each view's path exceeds this share of a cell's edge; lower
    #: keeps more of the rim of thin vessels, higher gives the predictor fewer points to judge
    min_path_cells: float = 0.5
    #: passes of the thinning that stands in for a model
    thinning_steps: int = 40
    #: power applied after each pass; above 1 weak shares give way to strong ones
    thinning_sharpness: float = 1.05


@dataclasses.dataclass(frozen=True, kw_only=True)
class PoseOptions:
    """Table or breath shift and angle error between views, from epipolar consistency."""

    enabled: bool = True
    #: priors, one standard deviation: how far a patient moves between runs, how well angles are
    #: read; a direction the pictures say nothing about stays at zero
    offset_sigma_mm: float = 3.0
    angle_sigma_deg: float = 0.7
    #: first search along the direction that two views see best, mm
    search_mm: float = 12.0
    step_mm: float = 1.0
    #: smoothing of the mass profiles, mm at the isocentre
    coarse_mm: float = 1.5
    fine_mm: float = 0.5
    #: how well two profiles of the same tree agree, as a share of their norm
    profile_noise: float = 0.05
    #: directions further apart than this are not compared: see ``estimate_poses``
    most_apart_deg: float = 150.0
    #: three and more views: directions nearer than this tell nothing of each other; and from how
    #: many starts their offsets are sought together
    least_apart_deg: float = 10.0
    joint_starts: int = 60
    #: more views than this are corrected pair by pair alone; pairs that disagree by no more than
    #: this as they are told, are left alone (four views of one tree, exactly placed, pixels of
    #: 1.4 mm: up to 0.08)
    joint_most_views: int = 4
    agreed: float = 0.09
    #: how well a person marks the same point in two views, mm at the isocentre
    landmark_sigma_mm: float = 0.5
    #: a correction must lower the disagreement to this share of what it was
    min_gain: float = 0.85
    max_evaluations: int = 40


@dataclasses.dataclass(frozen=True, kw_only=True)
class DecideOptions:
    """From confidences to a decision (see ``predict/decide.py``)."""

    steps: int = 24
    #: inverse temperature reached at the last step
    final_sharpness: float = 3.0
    #: weight of a vessel neighbour, and how many of the 26 are support enough
    coupling: float = 1.0
    enough_neighbours: float = 3.0
    #: how freely a ray may differ from its path length, cells squared per unit of evidence
    looseness: float = 0.5
    looseness_uncalibrated: float = 4.0


@dataclasses.dataclass(frozen=True, kw_only=True)
class SingleViewOptions:
    """How the centres that single views predict become one set (``predict/single_view.py``)."""

    #: a depth off by so many pixel edges of the network's picture counts a quarter; the shipped
    #: model is off by some 9 (median, generated scenes)
    depth_scale_pixels: float = 8.0


@dataclasses.dataclass(frozen=True, kw_only=True)
class PredictOptions:
    """Which Gaussian centre predictor to use, and how."""

    #: ``auto`` (the shipped model where there is one), ``multi``, ``single`` or ``none``
    predictor: str = "auto"
    #: edge of the lattice the predictor works on: the grid's own within these bounds, mm
    min_cell_mm: float = 0.85
    max_cell_mm: float = 1.5
    limits: ModelLimits = dataclasses.field(default_factory=ModelLimits)
    single: SingleViewOptions = dataclasses.field(default_factory=SingleViewOptions)


@dataclasses.dataclass(frozen=True, kw_only=True)
class TreeOptions:
    """From points to a centreline graph."""

    #: smoothing of the points' confidence before thresholding, lattice cells (sigma)
    smooth_cells: float = 0.6
    #: hysteresis on the smoothed confidence: kept from ``low`` where connected to ``high``
    low: float = 0.08
    high: float = 0.25
    #: a side branch must stick out of its parent by this many lattice cells
    min_branch_cells: float = 4.0
    #: a component shorter than this is dropped, lattice cells
    min_component_cells: float = 8.0
    #: gaps up to this long between a free end and another piece are bridged, lattice cells
    max_gap_cells: float = 5.0
    #: distance between centreline points, lattice cells
    step_cells: float = 0.8
    #: correlation length of the centreline's smoothing, lattice cells
    curve_cells: float = 2.0
    #: radii outside are not believed, mm
    min_radius_mm: float = 0.25
    max_radius_mm: float = 4.0


@dataclasses.dataclass(frozen=True, kw_only=True)
class TubeOptions:
    """The default refiner: tubes fitted to the pictures by Gauss-Newton."""

    #: working pixel at the isocentre per level, coarse to fine; 0 is the picture's own, mm
    levels_mm: tuple[float, ...] = (1.0, 0.0)
    #: most Gauss-Newton steps per level
    steps: tuple[int, ...] = (6, 5)
    #: noise of the path length: constant part, and share of the path, per mm^2 of picture
    noise_mm: float = 0.4
    noise_share: float = 0.05
    #: the share where the picture is not calibrated
    noise_share_uncalibrated: float = 0.25
    #: residuals beyond this many sigma lose weight (Cauchy)
    robust_sigmas: float = 2.0
    #: centreline: random walk of the direction, 1 / sqrt(mm)
    bend: float = 0.15
    #: radius: random walk of its log, 1 / sqrt(mm)
    taper: float = 0.1
    #: pixels below this at the isocentre show narrow cores, and loosen the taper in proportion, mm
    taper_pixel_mm: float = 0.85
    #: ... but at most so many times
    most_taper_easing: float = 3.0
    #: radii refitted with the axes held, on such fine pixels: steps, noise of the path length, mm
    calibre_steps: int = 3
    calibre_noise_mm: float = 0.15
    #: ... and the walk of their log: scale, 1 / sqrt(mm), and Student's degrees of freedom
    calibre_walk: float = 0.2
    calibre_freedom: float = 3.0
    #: starting points: standard deviation over 1 mm of centreline, mm
    anchor_mm: float = 1.0
    #: starting radii: standard deviation of the log over 1 mm of centreline
    anchor_log_radius: float = 0.5
    #: blur of vessel edges that is not the pixel's own (motion, focal spot), box width, mm
    edge_blur_mm: float = 0.5
    #: share of the pictures' weight that goes to their centreline alone (the paper's 1 - alpha)
    centreline_share: float = 0.0
    #: a level ends when a step lowers the objective by less than this share
    tolerance: float = 3e-3
    #: a branch or a free end is dropped where less than this share of it is seen in some view
    min_seen: float = 0.4
    #: branches are judged in pieces of at most this length, mm
    piece_mm: float = 100.0
    #: cost of a mm of piece per confidence below ``fair_confidence``, units of the objective
    piece_cost: float = 20.0
    fair_confidence: float = 0.4
    #: a piece is never dropped whose confidence is at least this share of the kept ones' median
    trusted_share: float = 0.8
    #: a piece standing alone is at most so many times as thick as the starting points say
    piece_growth: float = 2.5
    #: a piece is kept from this share on; 0 keeps all
    min_share: float = 0.5
    #: a dropped piece comes back where every view misses at least this share of it
    missed_share: float = 0.45
    #: free ends grow along what no tube explains, at most this far, mm
    max_growth_mm: float = 25.0
    #: prior on the geometry that the stated sigma includes: angles, and table position
    geometry_deg: float = 0.5
    geometry_mm: float = 0.5


@dataclasses.dataclass(frozen=True, kw_only=True)
class VolumeOptions:
    """From fitted tubes to voxels: how far real sections may differ from round ones."""

    #: correct the tubes' occupancy by pictures and starting points; else round tubes only
    fuse: bool = True
    #: standard deviation of a voxel half inside a tube, and of one far from its surface
    surface_sigma: float = 0.3
    floor_sigma: float = 0.03
    #: how far such differences reach along a vessel and across it, voxels (sigma)
    along_voxels: float = 1.0
    across_voxels: float = 0.6
    #: noise of the path length per pixel of about a voxel: constant part, share of the path
    noise_mm: float = 0.3
    noise_share: float = 0.1
    #: least noise of a lattice point's confidence; of scattered points: variance per occupancy
    confidence_sigma: float = 0.08
    scatter_variance: float = 0.25
    #: points scattered more than this say nothing about single voxels, voxels (sigma)
    max_scatter_voxels: float = 0.8
    #: more voxels than this near a surface are left to the round tubes
    max_cells: int = 60_000


@dataclasses.dataclass(frozen=True, kw_only=True)
class PaperOptions:
    """The paper's refinement: Gaussians, Adam, adaptive density control."""

    #: weight of the plain projection loss; the centreline loss has the rest (the paper's 0.5)
    alpha: float = 0.5
    steps: int = 150
    #: pictures are sampled to this pixel at the isocentre (the paper's 128^2), mm
    pixel_mm: float = 1.0
    #: learning rates: mm, log scale through its sigmoid, quaternion, softplus intensity
    rate_mean_mm: float = 0.05
    rate_scale: float = 0.05
    rate_rotation: float = 0.02
    rate_intensity: float = 0.05
    #: rates fall to this share of themselves over the steps
    final_rate: float = 0.2
    #: start: points at least so confident, sigma in cells, and the cap that always holds
    least_confidence: float = 0.3
    initial_sigma_cells: float = 0.55
    most_gaussians: int = 10_000
    #: points nearer than this to a more confident one share its Gaussian, cells; 0 keeps all.
    #: 1.1 halves Gaussians and time, and costs accuracy where the points are good
    thin_cells: float = 0.0
    #: bounds of the standard deviations
    least_sigma_pixels: float = 0.25
    largest_sigma_mm: float = 10.0
    #: density control: steps between, pull against the mean pull, size that splits, mass that goes
    control_every: int = 40
    pull_ratio: float = 4.0
    split_pixels: float = 1.5
    least_mass_share: float = 0.02
    #: stop when the best of so many steps is not better by this share
    patience: int = 20
    tolerance: float = 2e-3
    #: what projects: ``numpy``, or ``torch`` (the reference twin) on ``cpu`` or ``cuda``
    backend: str = "numpy"
    device: str = "cpu"


@dataclasses.dataclass(frozen=True, kw_only=True)
class RefineOptions:
    """The Gaussian refinement."""

    #: ``tube`` (default), ``paper`` or ``none``
    refiner: str = "tube"
    tube: TubeOptions = dataclasses.field(default_factory=TubeOptions)
    paper: PaperOptions = dataclasses.field(default_factory=PaperOptions)
    volume: VolumeOptions = dataclasses.field(default_factory=VolumeOptions)


@dataclasses.dataclass(frozen=True, kw_only=True)
class QualityOptions:
    """Gates between ``ok``, ``degraded`` and ``refused``."""

    #: best angle between two views, folded to 0 .. 90: depth errors are 1/sin of it times the
    #: errors in the picture, 11-fold at 5 deg (not worth having), 2.4-fold at 25 deg
    min_separation_deg: float = 5.0
    good_separation_deg: float = 25.0
    #: two views of one tree hold the same vessel mass in every epipolar plane; disagreement of
    #: the two profiles after the best shift, 0 (equal) .. 1 (disjoint). Nine simulated trees:
    #: 0.01 to 0.02 between path-length views of one tree, from 0.11 between those of two
    good_disagreement: float = 0.05
    max_disagreement: float = 0.09
    #: the same where vessels had to be found in raw pictures, which adds errors of its own: nine
    #: simulated raw pairs of one tree lie at 0.06 .. 0.48 and overlap with those of two trees
    #: (0.14 .. 0.58), so between these figures the finished tree decides: it leaves more than a
    #: tenth of the vessels of a view unexplained in all nine pairs of two trees, in one of one
    good_disagreement_raw: float = 0.13
    max_disagreement_raw: float = 0.6
    #: above this, nine of ten raw pairs of one tree (up to 0.28) are ruled out, and the largest
    #: part of each picture is asked alone: what else was found may be background
    parts_disagreement_raw: float = 0.35
    #: share of a view's skeleton that the reprojected tree explains
    good_coverage: float = 0.9
    min_coverage: float = 0.3
    #: share of the reprojected tree that lies on the view's vessels: at 0.99 and more
    #: in 49 generated trees (clinical views, exact and moved) that came out right
    good_support: float = 0.95
    min_support: float = 0.3
    #: how near counts, pixels of the picture, but at least so many mm at the isocentre: half a
    #: lattice cell is not an error
    near_px: float = 2.0
    near_mm: float = 1.0
    #: a larger estimated correction between the runs is no small matter of breath or table
    good_shift_mm: float = 5.0
    good_turn_deg: float = 1.5
    #: less tree than this is not a coronary tree
    min_length_mm: float = 20.0


@dataclasses.dataclass(frozen=True, kw_only=True)
class RunOptions:
    """Everything ``reconstruct`` needs to know beside pictures and geometry."""

    dicom: DicomOptions = dataclasses.field(default_factory=DicomOptions)
    imaging: ImagingOptions = dataclasses.field(default_factory=ImagingOptions)
    pose: PoseOptions = dataclasses.field(default_factory=PoseOptions)
    candidates: CandidateOptions = dataclasses.field(default_factory=CandidateOptions)
    predict: PredictOptions = dataclasses.field(default_factory=PredictOptions)
    decide: DecideOptions = dataclasses.field(default_factory=DecideOptions)
    tree: TreeOptions = dataclasses.field(default_factory=TreeOptions)
    refine: RefineOptions = dataclasses.field(default_factory=RefineOptions)
    quality: QualityOptions = dataclasses.field(default_factory=QualityOptions)
    #: points marked in the pictures, which hold the views to each other
    landmarks: tuple[Landmark, ...] = ()

"""Settings of the laser front-end."""

from __future__ import annotations

from pydantic import Field

from hybridmap.config.agreement import AgreementConfig
from hybridmap.config.section import Section


class ScanConfig(Section):
    """What is taken from one scan."""

    range_max_m: float = Field(default=20.0, gt=0)
    """Returns farther away are left out, m."""
    cell_m: float = Field(default=0.05, ge=0.005)
    """Points of one cell are merged into one, m."""
    profile_width: int = Field(default=64, ge=8)
    """Bearing columns of the scanline profile."""
    templates: bool = True
    """Whether every scan is compared with the view templates (`vision.templates`), as the `novelty` rule of nodes needs it."""


class RegistrationConfig(Section):
    """Likelihood field and point-to-line registration."""

    reach_m: float = Field(default=0.3, gt=0)
    """A point farther than this from every target point has no partner, m."""
    field_sigma_m: float = Field(default=0.12, gt=0)
    """Width of the likelihood field on which starts are scored, m."""
    cauchy_scale_m: float = Field(default=0.05, gt=0)
    """Residual at which a partner's weight is halved, m."""
    iterations: int = Field(default=20, ge=1)
    """Most iterations of point-to-line registration."""
    inlier_m: float = Field(default=0.1, gt=0)
    """Largest point-to-line residual of an inlier, m."""
    sigma_m: float = Field(default=0.01, gt=0)
    """Standard deviation of a point's residual at least, m."""
    spurious: float = Field(default=0.04, ge=0, lt=1)
    """Share of the inliers whose information along any direction is not believed: normals err by some 10 degrees."""


class SearchConfig(Section):
    """A grid of starts about the odometry, and how sure the odometry is taken to be."""

    half_m: float = Field(gt=0)
    """Half-width of the grid, m."""
    half_deg: float = Field(gt=0, le=180)
    """Half-width of the grid, degrees."""
    prior_m: float = Field(gt=0)
    """Standard deviation of the odometry's translation as prior of the registration, m."""
    prior_deg: float = Field(gt=0)
    """Standard deviation of the odometry's heading as prior of the registration, degrees."""


class TrackingConfig(Section):
    """Refined self-motion: each new node is registered to the submap of the last ones."""

    enabled: bool = True
    """Whether it is done; if not, submaps hang on the path integrator's motion alone."""
    submap_nodes: int = Field(default=25, ge=1)
    """Nodes in the submap."""
    narrow: SearchConfig = SearchConfig(half_m=0.2, half_deg=8.0, prior_m=0.1, prior_deg=5.0)
    """First search."""
    wide: SearchConfig = SearchConfig(half_m=0.45, half_deg=40.0, prior_m=0.1, prior_deg=40.0)
    """Second search, when the first is weak or contradicts the odometry: drop-outs of wheels are mostly of heading."""
    lost: SearchConfig = SearchConfig(half_m=1.0, half_deg=60.0, prior_m=0.7, prior_deg=60.0)
    """Last search, when the scans between the nodes did not help either."""
    inliers_min: float = Field(default=0.6, gt=0, le=1)
    """Least share of inliers of a good registration."""
    inliers_sure: float = Field(default=0.75, gt=0, le=1)
    """Least share of inliers at which a registration may contradict the odometry without further search."""
    inliers_weak: float = Field(default=0.45, gt=0, le=1)
    """Least share of inliers at which a registration still becomes an edge."""
    translation_max_m: float = Field(default=0.4, gt=0)
    """A registration whose translation is farther from the odometry's is refused, m."""
    contradiction_m: float = Field(default=0.15, gt=0)
    """A good registration this far from the odometry drops the odometry edge, m."""
    contradiction_deg: float = Field(default=3.0, gt=0)
    """The same, degrees."""
    floor_m: float = Field(default=0.001, gt=0)
    """Standard deviation of a node's place in the submap at least, m."""
    floor_deg: float = Field(default=0.02, gt=0)
    """The same, degrees."""


class ProbeConfig(Section):
    """Hypotheses of loop closure: submaps of the last metres against old submaps inside the gate."""

    every_m: float = Field(default=2.0, gt=0)
    """Travel between two probes, m."""
    length_m: float = Field(default=10.0, gt=0)
    """Travel that a probe covers, m."""
    target_every_m: float = Field(default=4.0, gt=0)
    """Travel between the anchors of old submaps, m."""
    target_half_m: float = Field(default=6.0, gt=0)
    """Travel that an old submap covers to either side of its anchor, m."""
    points: int = Field(default=120, ge=20)
    """Points of a probe that score the starts."""
    gate_sigmas: float = Field(default=2.5, gt=0)
    """Width of the gate in standard deviations of the propagated covariance. It has no cap."""
    gate_inflation: float = Field(default=4.0, ge=1)
    """Factor on those: a chain bends more than the covariances of its edges, taken as independent, would have it."""
    gate_m: float = Field(default=2.5, ge=0)
    """Width of the gate beside that, m."""
    gate_deg: float = Field(default=4.0, ge=0)
    """Width of the gate's heading beside that, degrees."""
    window_m: float = Field(default=3.5, gt=0)
    """A target is searched this far about its anchor; the next anchors take over beyond it, m."""
    targets: int = Field(default=16, ge=1)
    """Old submaps that are searched more closely, the likeliest."""
    modes_per_target: int = Field(default=2, ge=1)
    """Separated modes that a target may keep."""
    modes: int = Field(default=6, ge=1)
    """Modes that a probe may keep in all."""
    modes_sure: int = Field(default=3, ge=1)
    """The same where every gate is narrow (`commitment.sure_sigma_m`): then only one place is in question."""
    near_min: float = Field(default=0.5, gt=0, le=1)
    """Least share of the probe's points that lie near the target."""
    fit_min: float = Field(default=0.7, gt=0, le=1)
    """Least share of inliers among them."""
    violation_max: float = Field(default=0.15, ge=0, le=1)
    """Largest share of points of one submap in the free space of the other, either way."""
    loosest_max_m: float = Field(default=0.1, gt=0)
    """Largest standard deviation of the registration in any direction: a bare corridor is refused, m."""
    ambiguity_max: float = Field(default=0.9, gt=0, le=1)
    """Largest share of the likelihood that is left after a shift along the direction that the walls hold least."""
    floor_m: float = Field(default=0.004, gt=0)
    """Standard deviation of the registration of two submaps at least, m: what their bending hides."""
    floor_deg: float = Field(default=0.04, gt=0)
    """The same, degrees."""


class CommitmentConfig(Section):
    """Late commitment: hypotheses wait until a cluster of them beats its best rival."""

    wait_m: float = Field(default=32.0, gt=0)
    """Travel after which a hypothesis that found no cluster is given up, m."""
    probes: int = Field(default=3, ge=1)
    """Distinct probes that a cluster needs."""
    span_m: float = Field(default=3.0, ge=0)
    """Travel that they must cover, m, and more in a wide gate, where more places look alike."""
    sure_sigma_m: float = Field(default=0.8, gt=0)
    """Below this standard deviation of the gate one probe less is enough; above it more travel is needed, m."""
    span_per_efold_m: float = Field(default=1.0, ge=0)
    """Travel that they must cover beside that for each factor e by which the gate is wider, m."""
    rival: float = Field(default=0.75, gt=0, le=1)
    """The best rival cluster must score less than this share of the cluster."""


class RevisitConfig(Section):
    """Re-proposal on the optimised map, at the end."""

    rounds: int = Field(default=2, ge=0)
    """Most rounds."""
    radius_m: float = Field(default=2.5, gt=0)
    """Nodes nearer than this are registered again, m."""
    every_m: float = Field(default=1.0, gt=0)
    """Travel between two nodes that take part, m."""
    apart_m: float = Field(default=12.0, gt=0)
    """Travel between two passes, m."""
    partners: int = Field(default=3, ge=1)
    """Most earlier passes that a node is registered to."""
    probe_half_m: float = Field(default=1.5, gt=0)
    """Travel about the node whose scans are registered, m."""
    target_half_m: float = Field(default=4.0, gt=0)
    """Travel about the partner whose scans are registered to, m."""
    search_m: float = Field(default=0.45, gt=0)
    """Half-width of the grid of starts, m."""
    search_deg: float = Field(default=4.5, gt=0)
    """Half-width of the grid of starts, degrees."""
    ambiguous_m: float = Field(default=1.5, gt=0)
    """Standard deviation along a direction in which a registration is ambiguous, m."""
    floor_m: float = Field(default=0.002, gt=0)
    """Standard deviation of such a registration at least, m."""
    floor_deg: float = Field(default=0.025, gt=0)
    """The same, degrees."""


class RetraceConfig(Section):
    """Registration of every scan to the final map."""

    enabled: bool = True
    """Whether it is done."""
    block_nodes: int = Field(default=8, ge=1)
    """Consecutive nodes whose scans share one local map."""
    radius_m: float = Field(default=6.0, gt=0)
    """Nodes of the local map lie this near its middle, m."""
    map_nodes: int = Field(default=60, ge=1)
    """Most nodes of a local map, the nearest."""
    prior_m: float = Field(default=0.02, gt=0)
    """Standard deviation of the position that the wheels give between two nodes, m."""
    prior_deg: float = Field(default=6.0, gt=0)
    """Standard deviation of the heading that the wheels give between two nodes, degrees."""
    inliers_min: float = Field(default=0.6, gt=0, le=1)
    """Least share of inliers of a scan that is believed."""
    off_max_m: float = Field(default=0.3, gt=0)
    """Largest correction that is believed, m."""
    off_max_deg: float = Field(default=17.0, gt=0)
    """The same, degrees."""


class LaserRelocalisingConfig(AgreementConfig):
    """A robot that was carried away, or recognises nothing where it should, is looked for on the whole map."""

    span_m: float = Field(default=1.5, ge=0)
    """Travel that sightings must cover, m; more where they fit badly (`mismatch_max`)."""
    contradiction_sigmas: float = Field(default=4.0, gt=0)
    """A registration this far from the odometry, in deviations of the odometry, does not show that the robot drove there."""
    violation: float = Field(default=0.13, gt=0, le=1)
    """The odometry alone does not show it either: the chain is broken where beside that two consecutive scans see each other's
    walls, this share of them, in free space. 1: it never is."""
    unrecognised_probes: int = Field(default=2, ge=0)
    """Probes that recognise nothing while the map contradicts what is seen, with none that does between them, after which the
    robot is lost too; 0: never."""
    map_violation: float = Field(default=0.4, gt=0, le=1)
    """The map contradicts the last scans if more of either's walls than this share lie in the other's free space."""
    sure_m: float = Field(default=0.3, gt=0)
    """It can contradict them only where it is this sure of where they lie (standard deviation of the position), m."""
    from_m: float = Field(default=0.9, gt=0)
    """Travel since the break from which on the scans since then are held against the whole map, m."""
    often_m: float = Field(default=6.0, gt=0)
    """As far after the break it is done at each node, then as often as `probes.every_m`, m."""
    submaps: int = Field(default=100, ge=1)
    """Old submaps that are searched, at most; where there are more, those whose views are likest."""
    modes: int = Field(default=8, ge=1)
    """Modes that are verified."""
    misfit: float = Field(default=0.015, gt=0, lt=1)
    """Where the scans of the drive fit one another better than so (the share that does not), a sighting that fits as badly
    as elsewhere is a worse one: its mismatch counts for more, in proportion."""


class LaserConfig(Section):
    """Submap registration and commitment by cluster."""

    scan: ScanConfig = ScanConfig()
    """Points and profile of one scan."""
    registration: RegistrationConfig = RegistrationConfig()
    """Likelihood field and point-to-line registration."""
    tracking: TrackingConfig = TrackingConfig()
    """Refined self-motion."""
    probes: ProbeConfig = ProbeConfig()
    """Hypotheses of loop closure."""
    commitment: CommitmentConfig = CommitmentConfig()
    """When hypotheses become edges."""
    relocalising: LaserRelocalisingConfig = LaserRelocalisingConfig()
    """What a lost robot does."""
    revisits: RevisitConfig = RevisitConfig()
    """Re-proposal at the end."""
    retrace: RetraceConfig = RetraceConfig()
    """Every scan to the final map."""

//! Every number that registration uses, with its unit and origin.

use serde::{Deserialize, Serialize};

/// One scale of refinement.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Scale {
    /// Side of the voxels that both clouds are averaged over, metres.
    pub voxel_m: f32,
    /// Points further apart than this never correspond, metres (widened to 3 sigma where depth is noisier).
    pub max_correspondence_m: f32,
    /// Most Gauss-Newton steps.
    pub iterations: usize,
}

/// One of the last scales of refinement: pixels instead of averages over voxels, found by projection instead of nearness.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PixelScale {
    /// How often both pictures are halved, from the working size on; at most 4. Halved ones draw a motion in from farther away.
    pub halvings: u32,
    /// Most pixels of each view that look for a counterpart.
    pub points: usize,
    /// They lie this far apart, metres: evenly over the surfaces, not over the picture, which shows more of what is near.
    pub spacing_m: f32,
    /// Pixels further apart than this never correspond, metres (widened to 3 sigma where depth is noisier).
    pub max_correspondence_m: f32,
    /// Most Gauss-Newton steps.
    pub iterations: usize,
}

impl PixelScale {
    /// How often pictures are halved, whatever a file of settings says.
    pub(crate) fn bounded_halvings(&self) -> u32 {
        self.halvings.min(4)
    }
}

/// What refines a coarse pose.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Refiner {
    /// Coloured ICP: surfaces and brightness.
    #[default]
    Coloured,
    /// Generalised ICP: surfaces alone.
    Generalised,
}

/// Settings of [`align`](crate::align()).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Settings {
    /// Views are halved until they are at most this wide, pixels. Averaging also calms the depth.
    pub working_width: usize,
    /// Depth beyond this is left out, metres: a Kinect's error passes 2 cm at 3.2 m, 3 cm at 4 m.
    pub max_depth_m: f32,
    /// A pixel whose neighbour's depth differs by more than this share of its own lies on an edge and is left out.
    pub depth_jump: f32,
    /// What refines a coarse pose. Information and verification are the same for both.
    pub refiner: Refiner,
    /// Scales of refinement, coarse to fine. The first one is also that of the features.
    pub scales: Vec<Scale>,
    /// Radius of a feature's neighbourhood in voxels of the first scale (Open3D's 5).
    pub feature_radius_voxels: f32,
    /// Most neighbours of a feature (Open3D's 100).
    pub feature_neighbours: usize,
    /// A match must be among this many nearest features in both directions; 1 = mutual nearest neighbours.
    pub mutual_nearest: usize,
    /// Fewer matches than this are not tried.
    pub min_matches: usize,
    /// RANSAC: two matches agree if their distances differ by at most this, metres.
    pub edge_tolerance_m: f32,
    /// RANSAC: and if the angle between their normals differs by at most this, radians.
    pub normal_tolerance_rad: f32,
    /// RANSAC: a match is an inlier within this distance, metres (1.5 voxels).
    pub inlier_m: f32,
    /// RANSAC: most samples; drawn in batches of 256.
    pub samples: usize,
    /// RANSAC: stop once a better sample was missed with less than this probability.
    pub miss_probability: f64,
    /// Fewer inlier matches than this are no hypothesis. Low: the views themselves decide afterwards.
    pub min_inliers: usize,
    /// Distinct hypotheses that are scored against the depth maps.
    pub hypotheses: usize,
    /// The best of these get a coarse ICP.
    pub refined_hypotheses: usize,
    /// The best of those get the full treatment.
    pub verified_hypotheses: usize,
    /// Share of the geometric term in coloured ICP. Park 2017 has 0.968; a little less lets brightness hold what
    /// the bias of a real depth sensor drags along (kitchen pairs: median error 2.6 against 3.4 cm).
    pub geometric_share: f64,
    /// Most points of each cloud that look for a correspondence, per scale.
    pub icp_points: usize,
    /// The scales after those, coarse to fine: both views pixel by pixel. None: refinement ends with the finest voxels.
    pub pixels: Vec<PixelScale>,
    /// Fewer correspondences than this at the end are a divergence.
    pub min_correspondences: usize,
    /// Least share of the points seen by both views that must have a correspondence.
    pub min_fitness: f64,
    /// Residuals within one block of this share of the image's width count as one sample (4 of 320 pixels).
    pub blocks_across: u32,
    /// Parts of the image's width that may each be wrong in their own way; the motion is as unsure as they disagree.
    pub regions_across: u32,
    /// Standard deviations that this disagreement stands for: parts err together too, by what no residual shows.
    /// Calibrated on the built-in world with and without noise (mean squared normalised error 3 to 12).
    pub regional_scale: f64,
    /// Floor of the standard deviation of translation, metres.
    pub floor_m: f64,
    /// Floor of the standard deviation of rotation, radians (0.0015 degree).
    pub floor_rad: f64,
    /// Least ratio of the Hessian's smallest to its largest eigenvalue, rotation measured at the points' radius.
    pub min_eigenvalue_ratio: f64,
    /// Below this ratio the variance along an eigenvector is inflated by `weak_ratio / ratio`.
    pub weak_ratio: f64,
    /// How wrong the focal lengths may be, as a share: a Kinect with the maker's numbers is off by some 3 %.
    pub focal_uncertainty: f64,
    /// Farthest that this may move the translation, metres.
    pub max_calibration_m: f64,
    /// Two depths agree within this plus `depth_tolerance_sigmas` of both sensors' noise, metres.
    pub depth_tolerance_m: f32,
    /// See `depth_tolerance_m`.
    pub depth_tolerance_sigmas: f32,
    /// Least share of a view's points that the other must see at its own depth (the lesser direction).
    pub min_overlap: f64,
    /// Largest share of points, of those in agreement or conflict, that float in the other's free space. Right motions
    /// have none in a rendered room, at most 0.005 with the built-in world's noisy sensor, and nine of ten of a real
    /// kitchen's have less than 0.026; those that are off by 10 cm there have 0.02 to 0.07.
    pub max_conflict: f64,
    /// Least zero-mean normalised correlation of the intensities of agreeing points.
    pub min_correlation: f64,
    /// The same for edges and texture alone, the lesser direction.
    pub min_detail_correlation: f64,
    /// Intensities whose standard deviation is below this (of 0..1) in either view say nothing; the correlation is then not used.
    pub min_contrast: f64,
}

impl Default for Settings {
    fn default() -> Self {
        Settings {
            working_width: 320,
            max_depth_m: 4.0,
            depth_jump: 0.05,
            refiner: Refiner::Coloured,
            scales: vec![
                Scale { voxel_m: 0.05, max_correspondence_m: 0.15, iterations: 15 },
                Scale { voxel_m: 0.025, max_correspondence_m: 0.07, iterations: 15 },
                Scale { voxel_m: 0.0175, max_correspondence_m: 0.04, iterations: 12 },
            ],
            feature_radius_voxels: 5.0,
            feature_neighbours: 100,
            mutual_nearest: 1,
            min_matches: 12,
            edge_tolerance_m: 0.06,
            normal_tolerance_rad: 0.5,
            inlier_m: 0.075,
            samples: 8192,
            miss_probability: 1e-3,
            min_inliers: 6,
            hypotheses: 64,
            refined_hypotheses: 6,
            verified_hypotheses: 2,
            geometric_share: 0.94,
            icp_points: 2500,
            pixels: vec![PixelScale {
                halvings: 0,
                points: 10_000,
                spacing_m: 0.025,
                max_correspondence_m: 0.04,
                iterations: 8,
            }],
            min_correspondences: 200,
            min_fitness: 0.3,
            blocks_across: 80,
            regions_across: 4,
            regional_scale: 1.0,
            floor_m: 0.00003,
            floor_rad: 0.0015_f64.to_radians(),
            min_eigenvalue_ratio: 0.004,
            weak_ratio: 0.05,
            focal_uncertainty: 0.03,
            max_calibration_m: 0.04,
            depth_tolerance_m: 0.02,
            depth_tolerance_sigmas: 3.0,
            min_overlap: 0.2,
            max_conflict: 0.03,
            min_correlation: 0.6,
            min_detail_correlation: 0.27,
            min_contrast: 0.03,
        }
    }
}

//! What is left out.

use clap::ValueEnum;
use coma_slam::agent::SlamSettings;
use coma_slam::mapping::growth::GrowthRule;
use coma_slam::mapping::seed::Fit;
use coma_slam::tracking::Method;
use serde::Serialize;

/// One row of the table.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Variant {
    /// Everything as it is.
    Ours,
    /// 3D Gaussians in place of surfels.
    Gaussians,
    /// Surfels turned at random when they are made, with the mean of their two scales.
    Unfitted,
    /// The usual rule of growth.
    UsualGrowth,
    /// Surfels stay where they were born, submaps begin empty.
    Unfused,
    /// The paper's tracking, eq. 4.
    Adam,
    /// No loop is looked for.
    NoLoops,
}

impl Variant {
    /// Those that need no peers.
    pub const ALONE: [Variant; 6] = [
        Variant::Ours,
        Variant::Gaussians,
        Variant::Unfitted,
        Variant::UsualGrowth,
        Variant::Unfused,
        Variant::Adam,
    ];

    /// For readers.
    pub fn name(self) -> &'static str {
        match self {
            Variant::Ours => "ours",
            Variant::Gaussians => "without surfels (3D Gaussians)",
            Variant::Unfitted => "without surface-fitting initialisation",
            Variant::UsualGrowth => "without adaptive growing",
            Variant::Unfused => "without fusion and inheritance",
            Variant::Adam => "Adam in place of Gauss-Newton",
            Variant::NoLoops => "without loop closing",
        }
    }

    /// What exactly it changes.
    pub fn change(self) -> &'static str {
        match self {
            Variant::Ours => "the settings as they are",
            Variant::Gaussians => {
                "3D Gaussians in place of discs, fitted to the surface likewise and a tenth as thick as wide, through \
                 EWA splatting with gradients of its own; all parameters are optimised, without fusion or inheritance; \
                 a plain path, whose times say nothing of 3D Gaussians"
            }
            Variant::Unfitted => {
                "random rotation and the mean of the two scales; the optimiser may then turn surfels \
                 (0.02 rad a step)"
            }
            Variant::UsualGrowth => {
                "new where A < 0.98, or where the observation lies in front of the rendering by more than 50 \
                 times the median depth error; every pixel of the seed grid has a surfel of its own"
            }
            Variant::Unfused => "surfels stay where they were born, and submaps begin empty, as in the paper",
            Variant::Adam => "eq. 4 of the paper, in place of one rendering and Gauss-Newton",
            Variant::NoLoops => "`coma run --no-loops`",
        }
    }

    /// Its settings, from those that all share.
    pub fn settings(self, shared: &SlamSettings) -> SlamSettings {
        let mut settings = shared.clone();
        match self {
            // Gaussians have an agent of their own, which takes what is shared.
            Variant::Ours | Variant::Gaussians | Variant::NoLoops => {}
            Variant::Unfitted => {
                settings.mapping.seed.fit = Fit::Random;
                settings.mapping.optimise.rotation_rate_rad = 0.02;
            }
            Variant::UsualGrowth => {
                settings.mapping.growth = GrowthRule::Usual;
                settings.mapping.seed.even_color = 0.0;
            }
            Variant::Unfused => {
                settings.mapping.fuse.enabled = false;
                settings.mapping.inherit.enabled = false;
            }
            Variant::Adam => settings.tracking.method = Method::Adam,
        }
        settings
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_variant_but_ours_changes_the_settings_and_none_like_another() {
        let shared = SlamSettings::default();
        let with_surfels = Variant::ALONE.iter().filter(|v| **v != Variant::Gaussians);
        let all: Vec<SlamSettings> = with_surfels.map(|v| v.settings(&shared)).collect();
        assert_eq!(all[0], shared);
        for (i, a) in all.iter().enumerate() {
            assert!(all[..i].iter().all(|b| a != b), "row {i}");
        }
    }
}

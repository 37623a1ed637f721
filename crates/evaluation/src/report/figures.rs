//! The rows of the paper's tables, under both protocols.

use super::{MAPPING, Report, TRACKING};
use serde::Serialize;

/// One protocol's figures that the other doesn't share.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub(super) struct Quality {
    /// RMSE; `None` where coverage is too low for it to count.
    pub ate_rmse_m: Option<f64>,
    pub psnr_db: Option<f64>,
    pub ssim: Option<f64>,
    pub lpips: Option<f64>,
    pub depth_l1_m: Option<f64>,
}

#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub(super) struct Figures {
    /// One alignment for all agents; views that were never mapped.
    pub protocol_h: Quality,
    /// An alignment for each agent; views that the map was made from, of the refined map where there is one.
    pub protocol_p: Quality,
    pub tracking_per_frame_s: Option<f64>,
    pub mapping_per_frame_s: Option<f64>,
    pub map_bytes: Option<u64>,
    pub bytes_per_frame: Option<f64>,
}

impl Figures {
    pub(super) fn of(report: &Report) -> Self {
        let trajectories = report.trajectories.as_ref();
        let joint = trajectories.and_then(|scores| scores.joint()).filter(|joint| joint.counts);
        let quality = |ate_rmse_m, views: Option<crate::PictureScores>| Quality {
            ate_rmse_m,
            psnr_db: views.map(|views| views.psnr_db),
            ssim: views.map(|views| views.ssim),
            lpips: views.and_then(|views| views.lpips),
            depth_l1_m: views.and_then(|views| views.depth_l1_m),
        };
        Figures {
            protocol_h: quality(joint.and_then(|joint| Some(joint.ate_m?.rmse)), report.pictures.held_out),
            protocol_p: quality(
                trajectories.and_then(|scores| scores.mean_ate_p_m()),
                report.pictures.refined_training.or(report.pictures.training),
            ),
            tracking_per_frame_s: report.per_frame_s(TRACKING),
            mapping_per_frame_s: report.per_frame_s(MAPPING),
            map_bytes: report.map.map(|map| map.bytes),
            bytes_per_frame: report.bytes_per_frame(),
        }
    }
}

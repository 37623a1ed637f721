//! The variant without surfels: 3D Gaussians through EWA splatting, tracked and mapped by the same rules.

use super::alone::{Compared, Figures, Spent, picked};
use crate::bench::tracking;
use crate::progress;
use crate::source::Source;
use coma_raster::ewa::{GaussianView, render};
use coma_slam::agent::SlamSettings;
use coma_slam::gaussians::{GaussianAgent, GaussianSettings, GaussianSubmap};

/// Runs one agent. Its map is all its submaps together: what two of them show stays twice.
pub fn one(source: &Source, settings: &SlamSettings, views: usize) -> anyhow::Result<Figures> {
    let sequence = &*source.sequence;
    let bar = progress::frames(&source.agent, sequence.len() as u64);
    let mut agent = GaussianAgent::new(settings.clone(), GaussianSettings::default());
    let (mut track, mut map) = (Spent::default(), Spent::default());
    let mut found = Vec::new();
    for index in 0..sequence.len() {
        let frame = coma_dataset::sequence::rgbd_frame(sequence, index)?;
        let located = track.on(|| agent.locate(&frame));
        found.extend(map.on(|| agent.take(&frame, located)).map(|pose| (index, pose)));
        bar.inc(1);
    }
    bar.finish_and_clear();
    let submaps = agent.finish();
    let mut compared = Compared::default();
    for (index, agent_from_camera) in picked(&found, views) {
        let frame = coma_dataset::sequence::rgbd_frame(sequence, index)?;
        let camera_from_agent = agent_from_camera.inverse();
        let view = |submap: &'_ GaussianSubmap| camera_from_agent * submap.agent_from_submap;
        let views: Vec<GaussianView<'_>> = submaps
            .iter()
            .map(|s| GaussianView { gaussians: &s.gaussians, camera_from_submap: view(s) })
            .collect();
        let picture = render(&views, &frame.camera, &settings.render, None);
        compared.add(&picture.color, &picture.depth_m, &frame)?;
    }
    let count = submaps.iter().map(|s| s.gaussians.len()).sum();
    Ok(Figures {
        frames: sequence.len(),
        posed: found.len(),
        ate_m: tracking::ate_m(&found, sequence),
        views: compared.0,
        surfels: count,
        merged: count,
        track,
        map,
    })
}

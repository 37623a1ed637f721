//! One variant: each agent alone, from its first frame to its rendered map.

use super::gaussians;
use super::variant::Variant;
use crate::bench::cpu::process_ms;
use crate::bench::tracking;
use crate::progress;
use crate::source::{self, Source};
use coma_evaluation::{FrameScore, View, score_frame};
use coma_frame::{Image, RgbdFrame};
use coma_geometry::{AgentId, Epoch, Pose, SubmapId};
use coma_raster::{Outputs, RenderSettings, SubmapView, render_only};
use coma_slam::agent::{Agent, Event, FrameOptions, SlamSettings};
use coma_surfel::SurfelCloud;
use coma_surfel::merge::{MergeSettings, Part, merge};
use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Instant;

/// What one agent came to.
pub struct Figures {
    /// Frames of its sequence.
    pub frames: usize,
    /// Frames with a pose.
    pub posed: usize,
    /// RMSE after one rigid alignment; `None` without truth, or with too many frames lost.
    pub ate_m: Option<f64>,
    /// Its map against what its cameras saw.
    pub views: Vec<FrameScore>,
    /// Of its submaps.
    pub surfels: usize,
    /// Of its merged map.
    pub merged: usize,
    /// From the decoded frame to the pose.
    pub track: Spent,
    /// From the pose to the grown map.
    pub map: Spent,
}

/// Time of all frames.
#[derive(Clone, Copy, Debug, Default)]
pub struct Spent {
    /// Of all threads.
    pub processor_ms: f64,
    /// On the clock.
    pub wall_ms: f64,
}

impl Spent {
    /// Does some work and adds its time.
    pub fn on<T>(&mut self, work: impl FnOnce() -> T) -> T {
        let (begin, before_ms) = (Instant::now(), process_ms());
        let result = work();
        self.processor_ms += process_ms() - before_ms;
        self.wall_ms += begin.elapsed().as_secs_f64() * 1e3;
        result
    }
}

/// Runs all agents, one after the other.
pub fn run(
    variant: Variant,
    specs: &[String],
    shared: &SlamSettings,
    views: usize,
) -> anyhow::Result<Vec<Figures>> {
    let settings = variant.settings(shared);
    let one = |source: Source| match variant {
        Variant::Gaussians => gaussians::one(&source, &settings, views),
        _ => one(variant, &source, &settings, views),
    };
    source::open(specs)?.into_iter().map(one).collect()
}

fn one(variant: Variant, source: &Source, settings: &SlamSettings, views: usize) -> anyhow::Result<Figures> {
    let sequence = &*source.sequence;
    let bar = progress::frames(&source.agent, sequence.len() as u64);
    bar.set_message(variant.name());
    let mut agent = Agent::new(AgentId::new(&source.agent)?, Epoch(1), None, settings.clone());
    let (mut track, mut map) = (Spent::default(), Spent::default());
    let (mut found, mut submaps) = (Vec::new(), Submaps::default());
    for index in 0..sequence.len() {
        let frame = Arc::new(coma_dataset::sequence::rgbd_frame(sequence, index)?);
        let located = track.on(|| agent.locate(&frame));
        let outcome = map.on(|| agent.take(frame, located, FrameOptions::default()));
        found.extend(outcome.pose.map(|pose| (index, pose.agent_from_camera)));
        submaps.take(outcome.events);
        bar.inc(1);
    }
    submaps.take(agent.finish());
    bar.finish_and_clear();
    let merged = submaps.merged();
    Ok(Figures {
        frames: sequence.len(),
        posed: found.len(),
        ate_m: tracking::ate_m(&found, sequence),
        views: compare(source, &found, &merged, &settings.render, views)?,
        surfels: submaps.closed.values().map(|(surfels, _)| surfels.len()).sum(),
        merged: merged.len(),
        track,
        map,
    })
}

/// Closed submaps and where they lie.
#[derive(Default)]
struct Submaps {
    opened: BTreeMap<SubmapId, Pose>,
    closed: BTreeMap<SubmapId, (Arc<SurfelCloud>, Pose)>,
}

impl Submaps {
    fn take(&mut self, events: Vec<Event>) {
        for event in events {
            match event {
                Event::SubmapOpened(opened, _) => {
                    self.opened.insert(opened.id, opened.agent_from_submap);
                }
                Event::SubmapClosed(id, surfels) => {
                    if let Some(agent_from_submap) = self.opened.remove(&id) {
                        self.closed.insert(id, (surfels, agent_from_submap));
                    }
                }
                Event::Odometry(_) => {}
            }
        }
    }

    /// In the agent's frame.
    fn merged(&self) -> SurfelCloud {
        let part = |(surfels, pose): &'_ (Arc<SurfelCloud>, Pose)| (surfels.clone(), *pose);
        let held: Vec<(Arc<SurfelCloud>, Pose)> = self.closed.values().map(part).collect();
        let parts: Vec<Part<'_>> =
            held.iter().map(|(surfels, pose)| Part { surfels, map_from_submap: *pose }).collect();
        merge(&parts, &MergeSettings::default())
    }
}

/// Renders the map from evenly spread poses and compares it with the frames.
fn compare(
    source: &Source,
    found: &[(usize, Pose)],
    map: &SurfelCloud,
    render: &RenderSettings,
    views: usize,
) -> anyhow::Result<Vec<FrameScore>> {
    let mut out = Compared::default();
    for (index, agent_from_camera) in picked(found, views) {
        let frame = coma_dataset::sequence::rgbd_frame(&*source.sequence, index)?;
        let view = SubmapView::new(map, agent_from_camera.inverse());
        let rendering = render_only(&[view], &frame.camera, render, None, Outputs::Optimising);
        out.add(&rendering.color, &rendering.depth_m, &frame)?;
    }
    Ok(out.0)
}

/// At most `views` of the poses, evenly spread.
pub fn picked(found: &[(usize, Pose)], views: usize) -> impl Iterator<Item = (usize, Pose)> {
    let views = views.min(found.len());
    (0..views).map(move |k| found[(2 * k + 1) * found.len() / (2 * views)])
}

/// Rendered views against recorded ones.
#[derive(Default)]
pub struct Compared(pub Vec<FrameScore>);

impl Compared {
    /// Adds one.
    pub fn add(
        &mut self,
        color: &Image<[f32; 3]>,
        depth_m: &Image<f32>,
        frame: &RgbdFrame,
    ) -> anyhow::Result<()> {
        let recorded = frame.color.to_unit();
        let truth = View { color: &recorded, depth_m: &frame.depth_m };
        self.0.push(score_frame(View { color, depth_m }, truth, None)?);
        Ok(())
    }
}

//! One agent's life: frames in, poses and submaps out.
//!
//! ```text
//! frame -> guess -> frame-to-frame -> frame-to-model -> state -> grow -> optimise -> (submap full: next)
//! ```
//!
//! Nothing here knows other agents: what is seen by several is the work of [`crate::loop_closure`], and
//! its corrections move whole submaps, never a surfel (eq. 13). So the same frames give the same bits,
//! whatever the network does.

use crate::log::{OdometryEdge, SubmapOpened};
use crate::mapping::inherit::Inheritance;
use crate::mapping::submap::{ActiveSubmap, MappedFrame, MappingSettings};
use crate::odometry;
use crate::tracking::align::Brightness;
use crate::tracking::view::TrackingView;
use crate::tracking::{
    self, Reason, State, Tracked, TrackingSettings,
    model::{Model, Part},
};
use coma_frame::RgbdFrame;
use coma_geometry::{AgentId, Epoch, Matrix6, Pose, StampNs, SubmapId};
use coma_raster::RenderSettings;
use coma_surfel::SurfelCloud;
use serde::{Deserialize, Serialize};
use std::collections::VecDeque;
use std::sync::Arc;

/// Everything that can be set about one agent's tracking and mapping.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SlamSettings {
    /// Where is the camera?
    pub tracking: TrackingSettings,
    /// What does it see?
    pub mapping: MappingSettings,
    /// How surfels become pictures.
    pub render: RenderSettings,
}

/// The pose of one frame.
#[derive(Clone, Debug, PartialEq)]
pub struct FramePose {
    /// Position in the stream.
    pub sequence: u64,
    /// Sensor clock.
    pub stamp: StampNs,
    /// Which submap it belongs to.
    pub submap: SubmapId,
    /// Where it is in that submap; never changes.
    pub submap_from_camera: Pose,
    /// By odometry; never jumps within a chain.
    pub agent_from_camera: Pose,
    /// Of the camera in its submap, perturbed on the right.
    pub covariance: Matrix6,
    /// Takes the frame's brightness to the map's.
    pub brightness: Brightness,
}

/// What happened.
#[derive(Clone, Debug)]
pub enum Event {
    /// A submap began; its anchor is this frame.
    SubmapOpened(SubmapOpened, Arc<RgbdFrame>),
    /// Two submaps of one chain are tied by tracking.
    Odometry(OdometryEdge),
    /// A submap is finished.
    SubmapClosed(SubmapId, Arc<SurfelCloud>),
}

/// What became of a frame.
#[derive(Clone, Debug)]
pub struct FrameOutcome {
    /// How well the camera is known.
    pub state: State,
    /// Absent while the camera is lost.
    pub pose: Option<FramePose>,
    /// In order.
    pub events: Vec<Event>,
    /// Share of the pixels with depth that fit the map.
    pub share: f64,
    /// Of what the frame and the map both show, the share that fits.
    pub agreement: f64,
    /// What mapping did.
    pub mapped: MappedFrame,
}

/// What a frame is given.
#[derive(Clone, Copy, Debug)]
pub struct FrameOptions {
    /// Held-out frames are tracked, never mapped.
    pub map: bool,
    /// Optimiser steps that may be spent on this frame.
    pub step_budget: u32,
}

impl Default for FrameOptions {
    fn default() -> Self {
        FrameOptions { map: true, step_budget: u32::MAX }
    }
}

/// What the first half of a frame's way found.
#[derive(Clone, Debug)]
pub enum Located {
    /// There is no map to be found in: a chain begins here.
    Nowhere(TrackingView),
    /// Found in the map.
    Tracked(TrackingView, Tracked),
    /// Not found, and why.
    Lost(Vec<Reason>),
}

/// The tracker's memory of the frame before.
struct Previous {
    view: TrackingView,
    agent_from_camera: Pose,
    /// Motion of the last frame, in its own camera.
    motion: Pose,
}

/// A closed submap that is still tracked against.
#[derive(Clone, Debug)]
pub struct Recent {
    /// Its name.
    pub id: SubmapId,
    /// Its chain.
    pub chain: u32,
    /// Its surfels, without those that the next submap took over.
    pub surfels: Arc<SurfelCloud>,
    /// As it was measured, one for each surfel; without it that of their colour.
    pub intensity: Option<Vec<f32>>,
    /// By odometry.
    pub agent_from_submap: Pose,
}

impl Recent {
    /// Memory that its surfels take.
    pub fn bytes(&self) -> usize {
        let intensity = self.intensity.as_ref().map_or(0, |values| size_of_val(values.as_slice()));
        self.surfels.len() * SurfelCloud::SURFEL_BYTES + intensity
    }
}

/// Where an earlier life of this agent ended.
#[derive(Clone, Debug)]
pub struct Resume {
    /// Number of the next submap.
    pub next_submap: u32,
    /// Frames that were taken.
    pub frames: u64,
    /// The last closed submap.
    pub recent: Recent,
    /// Of the last tracked frame.
    pub agent_from_camera: Pose,
}

/// One agent's tracker and mapper.
pub struct Agent {
    id: AgentId,
    epoch: Epoch,
    settings: SlamSettings,
    next_submap: u32,
    next_chain: u32,
    active: Option<ActiveSubmap>,
    /// The chain's last closed submaps, oldest first.
    closed: VecDeque<Recent>,
    previous: Option<Previous>,
    brightness: Brightness,
    last_pose: Pose,
    /// Frames in a row whose pose is a guess.
    guesses: u32,
    /// Frames taken, over all sessions.
    frames: u64,
}

/// Guessed poses in a row before the camera is lost.
const MAX_GUESSES: u32 = 1;

impl Agent {
    /// An agent that has seen nothing, or one that goes on where its earlier life ended: it first looks for
    /// itself in its last submap.
    pub fn new(id: AgentId, epoch: Epoch, resume: Option<Resume>, settings: SlamSettings) -> Self {
        let (next_submap, next_chain, frames, recent, last_pose) = match resume {
            Some(r) => (r.next_submap, r.recent.chain + 1, r.frames, Some(r.recent), r.agent_from_camera),
            None => (0, 0, 0, None, Pose::identity()),
        };
        Agent {
            id,
            epoch,
            settings,
            next_submap,
            next_chain,
            active: None,
            closed: recent.into_iter().collect(),
            previous: None,
            brightness: Brightness::default(),
            last_pose,
            guesses: 0,
            frames,
        }
    }

    /// The submap under work: id, revision and surfels.
    pub fn active_submap(&self) -> Option<(&SubmapId, u64, &SurfelCloud)> {
        self.active.as_ref().map(|a| (&a.id, a.revision, &a.surfels))
    }

    /// Memory of the closed submaps that stay in the model.
    pub fn closed_bytes(&self) -> usize {
        self.closed.iter().map(Recent::bytes).sum()
    }

    /// Takes a frame: tracks it, and maps it if allowed.
    pub fn on_frame(&mut self, frame: Arc<RgbdFrame>, options: FrameOptions) -> FrameOutcome {
        let located = self.locate(&frame);
        self.take(frame, located, options)
    }

    /// The first half of [`Agent::on_frame`]: where is the camera? Changes nothing.
    pub fn locate(&self, frame: &RgbdFrame) -> Located {
        let levels = self.settings.tracking.levels();
        let share = frame.depth_coverage();
        if !(share >= self.settings.tracking.min_depth_share) {
            let needed = self.settings.tracking.min_depth_share * 100.0;
            return Located::Lost(vec![Reason::LittleDepth { share: share * 100.0, needed }]);
        }
        let view = TrackingView::from_frame(frame, levels);
        match (&self.active, self.closed.back()) {
            (None, None) => Located::Nowhere(view),
            (None, Some(_)) => match self.relocate(&view) {
                Some(tracked) => Located::Tracked(view, tracked),
                None => Located::Nowhere(view),
            },
            _ => match self.track(frame, &view) {
                Ok(tracked) => Located::Tracked(view, tracked),
                Err(reasons) => Located::Lost(reasons),
            },
        }
    }

    /// The second half: the frame's pose is kept, and the map grows. `located` must be of this frame.
    pub fn take(&mut self, frame: Arc<RgbdFrame>, located: Located, options: FrameOptions) -> FrameOutcome {
        self.frames += 1;
        match located {
            Located::Nowhere(view) => self.start_chain(frame, view, options),
            Located::Tracked(view, tracked) => self.keep(frame, view, tracked, options),
            Located::Lost(reasons) => self.lose(reasons),
        }
    }

    /// Looks for a camera that was lost in the submap where it was lost: a hand before the lens, or a restart.
    fn relocate(&self, view: &TrackingView) -> Option<Tracked> {
        let settings = &self.settings.tracking;
        let found =
            tracking::frame_to_model(&self.model(), view, &self.last_pose, self.brightness, settings).ok()?;
        (found.share >= settings.relocate_share).then_some(found)
    }

    /// Closes the submap under work: the stream has ended.
    pub fn finish(&mut self) -> Vec<Event> {
        self.previous = None;
        let events = self.close_active(&[]).into_iter().collect();
        self.closed.clear();
        events
    }

    fn track(&self, frame: &RgbdFrame, view: &TrackingView) -> Result<Tracked, Vec<Reason>> {
        let settings = &self.settings.tracking;
        let guess = match &self.previous {
            Some(previous) => {
                let moved = tracking::frame_to_frame(&previous.view, view, &previous.motion, settings)
                    .map_or(previous.motion, |found| found.reference_from_camera);
                previous.agent_from_camera * moved
            }
            None => self.last_pose,
        };
        tracking::against_model(&self.model(), frame, view, &guess, self.brightness, settings)
    }

    fn model(&self) -> Model<'_> {
        let closed = self.closed.iter().map(|r| Part {
            surfels: &r.surfels,
            intensity: r.intensity.as_deref(),
            agent_from_submap: r.agent_from_submap,
        });
        let active = self.active.iter().map(|a| Part {
            surfels: &a.surfels,
            intensity: Some(&a.measured.intensity),
            agent_from_submap: a.agent_from_submap,
        });
        Model { submaps: closed.chain(active).collect(), render: &self.settings.render }
    }

    /// A first submap, or the first after the camera was lost: its chain is tied to nothing yet.
    fn start_chain(
        &mut self,
        frame: Arc<RgbdFrame>,
        view: TrackingView,
        options: FrameOptions,
    ) -> FrameOutcome {
        let tracked = Tracked {
            agent_from_camera: self.last_pose,
            brightness: self.brightness,
            covariance: Matrix6::zeros(),
            share: 1.0,
            agreement: 1.0,
            noise_ratio: 1.0,
            map_at_once: false,
            hits: 0,
        };
        self.previous = None;
        self.closed.clear();
        let chain = self.next_chain;
        self.next_chain += 1;
        let (_, opened) = self.open_submap(&frame, chain, self.last_pose, Inheritance::default());
        let mut outcome = self.keep(frame, view, tracked, FrameOptions { map: true, ..options });
        outcome.events.insert(0, opened);
        outcome
    }

    /// A tracked frame: its pose is kept, the map grows.
    fn keep(
        &mut self,
        frame: Arc<RgbdFrame>,
        view: TrackingView,
        tracked: Tracked,
        options: FrameOptions,
    ) -> FrameOutcome {
        self.guesses = 0;
        self.brightness = tracked.brightness;
        let mut events = Vec::new();
        let mut inherited = Inheritance::default();
        let full = self.active.as_ref().filter(|a| options.map && a.is_full(&self.settings.mapping));
        if let Some(full) = full {
            let submap_from_anchor = full.agent_from_submap.inv_mul(&tracked.agent_from_camera);
            inherited = full.bequeath(&submap_from_anchor, &view, &self.settings.mapping);
            events.extend(self.close_active(&inherited.taken));
        }
        if self.active.is_none() {
            events.extend(self.follow_recent(&frame, &tracked, inherited));
        }
        let mut mapped = MappedFrame::default();
        let pose = self.active.as_mut().map(|active| {
            let submap_from_camera = active.agent_from_submap.inv_mul(&tracked.agent_from_camera);
            if options.map {
                mapped = active.map(
                    &frame,
                    &view,
                    &submap_from_camera,
                    tracked.brightness,
                    tracked.map_at_once,
                    options.step_budget,
                    &self.settings.mapping,
                    &self.settings.render,
                );
            }
            FramePose {
                sequence: frame.sequence,
                stamp: frame.stamp,
                submap: active.id.clone(),
                submap_from_camera,
                agent_from_camera: tracked.agent_from_camera,
                covariance: tracked.covariance,
                brightness: tracked.brightness,
            }
        });
        let motion = match &self.previous {
            Some(previous) => previous.agent_from_camera.inv_mul(&tracked.agent_from_camera),
            None => Pose::identity(),
        };
        self.last_pose = tracked.agent_from_camera;
        self.previous = Some(Previous { view, agent_from_camera: tracked.agent_from_camera, motion });
        let TrackingSettings { degraded_share, degraded_sigma_m: needed, .. } = self.settings.tracking;
        let mut reasons = Vec::new();
        if tracked.share < degraded_share {
            let (share, needed) = (tracked.share * 100.0, degraded_share * 100.0);
            reasons.push(Reason::FewFit { share, needed });
        }
        let metres = tracked.sigma_m();
        if metres > needed {
            reasons.push(Reason::Uncertain { metres, needed });
        }
        let state = if reasons.is_empty() { State::Tracking } else { State::Degraded(reasons) };
        FrameOutcome { state, pose, events, share: tracked.share, agreement: tracked.agreement, mapped }
    }

    /// A frame that could not be tracked. The first of a row gets no pose but may still be found again from
    /// the frame before; then the chain ends, and the next frame that shows something starts another.
    fn lose(&mut self, reasons: Vec<Reason>) -> FrameOutcome {
        let may_recover = self.guesses < MAX_GUESSES && self.active.is_some();
        if may_recover {
            self.guesses += 1;
            if let Some(previous) = &mut self.previous {
                // Whatever moved the camera, the motion before says little of it now.
                previous.motion = Pose::identity();
            }
        }
        let events = if may_recover { Vec::new() } else { self.close_active(&[]).into_iter().collect() };
        if !may_recover {
            self.previous = None;
        }
        let state = if may_recover { State::Degraded(reasons) } else { State::Lost(reasons) };
        FrameOutcome { state, pose: None, events, share: 0.0, agreement: 0.0, mapped: MappedFrame::default() }
    }

    /// Opens the submap after the last closed one, in its chain and tied to it.
    fn follow_recent(
        &mut self,
        frame: &Arc<RgbdFrame>,
        tracked: &Tracked,
        inherited: Inheritance,
    ) -> Vec<Event> {
        let Some(recent) = self.closed.back() else { return Vec::new() };
        let (from, chain) = (recent.id.clone(), recent.chain);
        let from_from_to = recent.agent_from_submap.inv_mul(&tracked.agent_from_camera);
        let (to, opened) = self.open_submap(frame, chain, tracked.agent_from_camera, inherited);
        let information = odometry::information(&from_from_to, tracked, frame);
        vec![opened, Event::Odometry(OdometryEdge { from, to, from_from_to, information })]
    }

    fn open_submap(
        &mut self,
        frame: &Arc<RgbdFrame>,
        chain: u32,
        agent_from_submap: Pose,
        inherited: Inheritance,
    ) -> (SubmapId, Event) {
        let id = SubmapId { agent: self.id.clone(), epoch: self.epoch, number: self.next_submap };
        self.next_submap += 1;
        self.active = Some(ActiveSubmap::open(id.clone(), chain, agent_from_submap, inherited));
        let opened = SubmapOpened {
            id: id.clone(),
            anchor_frame: self.frames - 1,
            anchor_stamp: frame.stamp,
            agent_from_submap,
            chain,
        };
        (id, Event::SubmapOpened(opened, frame.clone()))
    }

    /// Lets the oldest closed submaps go that are beyond the number or the bytes that may stay. The last one stays.
    fn evict(&mut self) {
        let settings = &self.settings.tracking;
        let budget_bytes = settings.resident_budget_mb * 1e6;
        let mut bytes = self.closed_bytes();
        while self.closed.len() > settings.closed_submaps.max(1)
            || (self.closed.len() > 1 && bytes as f64 > budget_bytes)
        {
            let Some(oldest) = self.closed.pop_front() else { return };
            bytes -= oldest.bytes();
        }
    }

    /// Finishes the submap under work. But for what the next one has `taken` over, it stays to be tracked against.
    fn close_active(&mut self, taken: &[bool]) -> Option<Event> {
        let active = self.active.take()?;
        let (id, chain, agent_from_submap) = (active.id.clone(), active.chain, active.agent_from_submap);
        let (rest, intensity) = active.rest(taken, &self.settings.mapping);
        let surfels = Arc::new(active.close(&self.settings.mapping));
        self.closed.push_back(Recent {
            id: id.clone(),
            chain,
            surfels: Arc::new(rest),
            intensity: Some(intensity),
            agent_from_submap,
        });
        self.evict();
        Some(Event::SubmapClosed(id, surfels))
    }
}

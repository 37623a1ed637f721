//! The mapping thread: takes frames one by one, runs the agent's state machine, and passes on what happened.

use crate::journal::Checkpoint;
use crate::knowledge::{OwnSubmap, TrajectoryPose};
use crate::node::Node;
use crate::queue::Job;
use crate::session::Processed;
use coma_frame::RgbdFrame;
use coma_geometry::SubmapId;
use coma_slam::agent::{Agent, Event, FrameOptions, FrameOutcome, FramePose, Recent, Resume};
use coma_slam::log::Payload;
use coma_surfel::SurfelCloud;
use std::sync::Arc;
use std::time::Instant;
use tracing::error;

/// Where an earlier life ended, from what the disk holds.
pub fn resume_from(node: &Node, checkpoints: &[Checkpoint]) -> anyhow::Result<Option<Resume>> {
    let mut knowledge = node.lock();
    let own = (knowledge.agent.clone(), knowledge.epoch);
    let opened: Vec<_> = knowledge
        .closer
        .submaps()
        .filter(|(id, _)| (&id.agent, id.epoch) == (&own.0, own.1))
        .map(|(_, facts)| facts.opened.clone())
        .collect();
    let Some(last) = opened.iter().map(|o| o.id.number).max() else { return Ok(None) };
    let closed = checkpoints.iter().rev().find_map(|c| c.submap.clone());
    let pose = checkpoints.iter().rev().find_map(|c| c.poses.last().cloned());
    let (Some((id, blob, _)), Some(pose)) = (closed, pose) else { return Ok(None) };
    let Some(facts) = opened.iter().find(|o| o.id == id) else { return Ok(None) };
    let surfels = Arc::new(knowledge.journal.surfels(&blob)?);
    Ok(Some(Resume {
        next_submap: last + 1,
        frames: knowledge.frames,
        recent: Recent {
            id,
            chain: facts.chain,
            surfels,
            intensity: None,
            agent_from_submap: facts.agent_from_submap,
        },
        agent_from_camera: pose.agent_from_camera,
    }))
}

/// Runs until the queue is closed.
pub fn run(node: Arc<Node>, agent: Agent, threads: Option<usize>) {
    let mut pool = rayon::ThreadPoolBuilder::new().thread_name(|i| format!("map-{i}"));
    if let Some(threads) = threads {
        pool = pool.num_threads(threads.max(1));
    }
    let pool = match pool.build() {
        Ok(pool) => pool,
        Err(e) => return error!(error = %e, "the mapping threads could not be started"),
    };
    let mut worker = Worker { node, agent, since_checkpoint: Vec::new(), last_sequence: None };
    while let Some(job) = worker.node.queue.pop() {
        let done = pool.install(|| match job {
            Job::Frame { frame, map, step_budget } => worker.frame(frame, FrameOptions { map, step_budget }),
            Job::Finish(reply) => {
                let result = worker.finish();
                // The client may have gone; the submap is closed all the same.
                let _ = reply.send(());
                result
            }
        });
        if let Err(e) = done {
            error!(error = %format!("{e:#}"), "what a frame changed could not be kept on disk");
            worker.node.lock().warnings.push(format!("the disk failed: {e:#}"));
        }
    }
}

struct Worker {
    node: Arc<Node>,
    agent: Agent,
    since_checkpoint: Vec<FramePose>,
    last_sequence: Option<u64>,
}

impl Worker {
    fn frame(&mut self, frame: Arc<RgbdFrame>, options: FrameOptions) -> anyhow::Result<()> {
        let begin = Instant::now();
        let located = self.agent.locate(&frame);
        let tracked_s = begin.elapsed().as_secs_f64();
        let outcome = self.agent.take(frame.clone(), located, options);
        let mapped_s = begin.elapsed().as_secs_f64() - tracked_s;
        let mut durable_through = None;
        for event in &outcome.events {
            if let Some(through) = self.on_event(event, &frame, &outcome)? {
                durable_through = Some(through);
            }
        }
        self.last_sequence = Some(frame.sequence);
        self.since_checkpoint.extend(outcome.pose.clone());
        let active = self.agent.active_submap().map(|(id, revision, surfels)| {
            // Viewers get the submap under work now and then; copying it each time would cost more than mapping.
            let fresh = outcome.mapped.steps > 0;
            (id.clone(), revision, surfels.len() as u64, fresh.then(|| Arc::new(surfels.clone())))
        });
        let mut knowledge = self.node.lock();
        knowledge.frames += 1;
        knowledge.state = outcome.state.clone();
        *knowledge.stage_seconds.entry("tracking".into()).or_default() += tracked_s;
        *knowledge.stage_seconds.entry("mapping".into()).or_default() += mapped_s;
        if let Some((id, revision, surfels, copy)) = active {
            knowledge.submaps.insert(id.clone(), OwnSubmap { revision, surfels, blob: None });
            if let Some(copy) = copy {
                knowledge.active = Some((id, copy));
            }
        }
        if let Some(pose) = &outcome.pose {
            knowledge.trajectory.push(TrajectoryPose { pose: pose.clone(), state: outcome.state.clone() });
        }
        let estimate = knowledge.trajectory.last().filter(|_| outcome.pose.is_some()).cloned();
        let message = estimate.map(|e| crate::convert::pose_estimate(&knowledge, &e));
        drop(knowledge);
        if let Some(message) = &message {
            self.node.publish(coma_wire::v1::watch_response::Event::Pose(message.clone()));
        }
        self.node.session_progress(Processed {
            sequence: frame.sequence,
            durable_through,
            pose: message,
            state: outcome.state,
            work_budget: options.step_budget,
            work_used: outcome.mapped.steps,
            tracking_s: tracked_s,
            mapping_s: mapped_s,
        });
        Ok(())
    }

    /// Passes an event on; where it made frames durable, up to which.
    fn on_event(
        &mut self,
        event: &Event,
        frame: &RgbdFrame,
        outcome: &FrameOutcome,
    ) -> anyhow::Result<Option<u64>> {
        match event {
            Event::SubmapOpened(opened, anchor) => {
                self.node.lock().write(&Payload::SubmapOpened(opened.clone()))?;
                self.node.describe(opened.id.clone(), anchor.clone());
                self.node.entries_changed();
                Ok(None)
            }
            Event::Odometry(edge) => {
                self.node.lock().write(&Payload::OdometryEdge(edge.clone()))?;
                self.node.entries_changed();
                Ok(None)
            }
            Event::SubmapClosed(id, surfels) => {
                // This frame belongs to the next submap, unless the camera was lost.
                let next = outcome.pose.as_ref().is_some_and(|p| p.submap != *id);
                let through = if next { self.last_sequence } else { Some(frame.sequence) };
                self.close(id, surfels, through)
            }
        }
    }

    fn close(
        &mut self,
        id: &SubmapId,
        surfels: &SurfelCloud,
        through: Option<u64>,
    ) -> anyhow::Result<Option<u64>> {
        let Some(through) = through else { return Ok(None) };
        let session = self.node.session_id();
        let mut knowledge = self.node.lock();
        let blob = knowledge.journal.put_surfels(surfels)?;
        let count = surfels.len() as u64;
        let checkpoint = Checkpoint {
            session,
            through,
            frames: knowledge.frames,
            submap: Some((id.clone(), blob, count)),
            poses: std::mem::take(&mut self.since_checkpoint),
        };
        knowledge.journal.checkpoint(&checkpoint)?;
        knowledge.set_durable(checkpoint.session, through);
        let revision = knowledge.submaps.get(id).map_or(1, |s| s.revision + 1);
        let closed = OwnSubmap { revision, surfels: count, blob: Some(blob) };
        knowledge.submaps.insert(id.clone(), closed);
        if knowledge.active.as_ref().is_some_and(|(active, _)| active == id) {
            knowledge.active = None;
        }
        let info = crate::convert::submap_info(&knowledge, id);
        drop(knowledge);
        if let Some(info) = info {
            self.node.publish(coma_wire::v1::watch_response::Event::Submap(info));
        }
        Ok(Some(through))
    }

    fn finish(&mut self) -> anyhow::Result<()> {
        for event in self.agent.finish() {
            if let Event::SubmapClosed(id, surfels) = &event {
                self.close(id, surfels, self.last_sequence)?;
            }
        }
        self.last_sequence = None;
        Ok(())
    }
}

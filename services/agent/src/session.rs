//! One client's session: what it said of its sensor, and how far it is.

use coma_geometry::StampNs;
use coma_slam::tracking::State;
use coma_wire::{Calibration, FieldError, v1};

/// The open session.
#[derive(Clone, Debug)]
pub struct Session {
    /// Chosen by the client or made by the agent.
    pub id: String,
    /// What it said of its sensor.
    pub calibration: Calibration,
    /// What happens to a frame that finds the queue full.
    pub policy: v1::QueuePolicy,
    /// Every so many frames is tracked, never mapped; 0: none.
    pub hold_out_every: u32,
    /// Last sequence and stamp taken.
    pub received: Option<(u64, StampNs)>,
    /// Last sequence processed.
    pub processed: Option<u64>,
    /// Last sequence whose effect is on disk.
    pub durable: Option<u64>,
    /// Frames taken in this session, for the hold-out rhythm.
    pub frames: u64,
    /// Frames dropped under `latest`.
    pub dropped: u64,
    /// Optimiser steps that a frame is given now.
    pub step_budget: u32,
}

/// What the mapping thread says of a frame.
#[derive(Clone, Debug)]
pub struct Processed {
    /// Which frame.
    pub sequence: u64,
    /// A submap was closed: frames up to here survive kill -9.
    pub durable_through: Option<u64>,
    /// Absent while the camera is lost.
    pub pose: Option<v1::PoseEstimate>,
    /// How well the camera is known.
    pub state: State,
    /// Optimiser steps that it was given.
    pub work_budget: u32,
    /// And used.
    pub work_used: u32,
    /// Wall time, seconds.
    pub tracking_s: f64,
    /// Wall time, seconds.
    pub mapping_s: f64,
}

impl Session {
    /// Checks a frame's place in the stream, and takes it.
    pub fn admit(&mut self, sequence: u64, stamp: StampNs) -> Result<(), FieldError> {
        if let Some((last, last_stamp)) = self.received {
            if sequence <= last {
                let message =
                    format!("{sequence} was received already: {last} was the last, sequences increase");
                return Err(FieldError::new("frame.sequence", message));
            }
            if stamp <= last_stamp {
                let message =
                    format!("{} ns does not lie after the frame before, {} ns", stamp.0, last_stamp.0);
                return Err(FieldError::new("frame.stamp_ns", message));
            }
        }
        self.received = Some((sequence, stamp));
        self.frames += 1;
        Ok(())
    }

    /// True for frames that may be mapped; the first always is.
    pub fn maps_this_frame(&self) -> bool {
        self.hold_out_every == 0
            || !(self.frames - 1).is_multiple_of(self.hold_out_every as u64)
            || self.frames == 1
    }

    /// Adapts a live camera's work budget to the clock: less when frames had to be dropped, more when not.
    /// Recorded data has a constant budget, so that runs repeat exactly.
    pub fn adapt_budget(&mut self, dropped: u64, full_budget: u32) {
        if self.policy != v1::QueuePolicy::Latest {
            return;
        }
        self.dropped += dropped;
        self.step_budget =
            if dropped > 0 { self.step_budget / 2 } else { (self.step_budget + 1).min(full_budget) };
    }

    /// The ack of a processed frame.
    pub fn ack(&self, processed: &Processed) -> v1::FrameAck {
        let mut pose = processed.pose.clone();
        if pose.is_none() {
            // A lost camera has no pose, but its state and reasons are said.
            pose = Some(v1::PoseEstimate {
                sequence: processed.sequence,
                state: crate::convert::state(&processed.state).into(),
                reasons: crate::convert::reasons(&processed.state),
                ..Default::default()
            });
        }
        v1::FrameAck {
            received_through: self.received.map(|(sequence, _)| sequence),
            processed_through: self.processed,
            durable_through: self.durable,
            pose,
            dropped_frames: self.dropped,
            work_budget: processed.work_budget.into(),
            work_used: processed.work_used.into(),
            tracking_s: processed.tracking_s,
            mapping_s: processed.mapping_s,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use coma_geometry::Intrinsics;

    fn session() -> Session {
        let color = Intrinsics { width: 16, height: 12, fx: 14.0, fy: 14.0, cx: 7.5, cy: 5.5 };
        Session {
            id: "s".into(),
            calibration: Calibration::registered(color, 1000.0),
            policy: v1::QueuePolicy::Block,
            hold_out_every: 0,
            received: None,
            processed: None,
            durable: None,
            frames: 0,
            dropped: 0,
            step_budget: 8,
        }
    }

    #[test]
    fn repeated_sequences_and_stamps_that_go_back_are_refused_by_field() {
        let mut session = session();
        session.admit(4, StampNs(100)).unwrap();
        assert_eq!(session.admit(4, StampNs(200)).unwrap_err().field, "frame.sequence");
        assert_eq!(session.admit(5, StampNs(100)).unwrap_err().field, "frame.stamp_ns");
        session.admit(5, StampNs(101)).unwrap();
    }

    #[test]
    fn every_k_th_frame_is_held_out_but_never_the_first() {
        let mut session = Session { hold_out_every: 5, ..session() };
        let held: Vec<u64> = (0..12)
            .filter(|i| {
                session.admit(*i, StampNs(*i as i64)).unwrap();
                !session.maps_this_frame()
            })
            .collect();
        assert_eq!(held, [5, 10]);
    }

    #[test]
    fn only_a_live_camera_s_budget_follows_the_clock() {
        let mut recorded = session();
        recorded.adapt_budget(3, 8);
        assert_eq!(recorded.step_budget, 8);
        let mut live = Session { policy: v1::QueuePolicy::Latest, ..session() };
        live.adapt_budget(3, 8);
        assert_eq!((live.step_budget, live.dropped), (4, 3));
        (0..20).for_each(|_| live.adapt_budget(0, 8));
        assert_eq!(live.step_budget, 8);
    }
}

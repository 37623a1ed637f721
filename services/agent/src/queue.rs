//! The bounded queue between the streams and the mapping thread.

use coma_frame::RgbdFrame;
use std::collections::VecDeque;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use tokio::sync::{Notify, oneshot};

/// Work for the mapping thread.
pub enum Job {
    /// A frame of the open session.
    Frame {
        /// Decoded.
        frame: Arc<RgbdFrame>,
        /// False for held-out frames.
        map: bool,
        /// Optimiser steps it may use.
        step_budget: u32,
    },
    /// The session ends: close the submap under work, then answer.
    Finish(oneshot::Sender<()>),
}

#[derive(Default)]
struct Inner {
    jobs: VecDeque<Job>,
    in_work: bool,
    closed: bool,
}

/// At most `capacity` frames wait.
pub struct FrameQueue {
    inner: Mutex<Inner>,
    arrived: Condvar,
    left: Notify,
    capacity: usize,
}

impl FrameQueue {
    /// An empty queue.
    pub fn new(capacity: usize) -> Self {
        FrameQueue {
            inner: Mutex::default(),
            arrived: Condvar::new(),
            left: Notify::new(),
            capacity: capacity.max(1),
        }
    }

    fn lock(&self) -> MutexGuard<'_, Inner> {
        self.inner.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Policy `block`: waits for room. False once the queue is closed.
    pub async fn push_waiting(&self, job: Job) -> bool {
        loop {
            let left = self.left.notified();
            {
                let mut inner = self.lock();
                if inner.closed {
                    return false;
                }
                if inner.jobs.len() < self.capacity {
                    inner.jobs.push_back(job);
                    self.arrived.notify_one();
                    return true;
                }
            }
            left.await;
        }
    }

    /// Policy `latest`: the oldest waiting frame makes room; how many were dropped.
    pub fn push_dropping(&self, job: Job) -> u64 {
        let mut inner = self.lock();
        let mut dropped = 0;
        while inner.jobs.len() >= self.capacity {
            let Some(oldest) = inner.jobs.iter().position(|j| matches!(j, Job::Frame { .. })) else { break };
            inner.jobs.remove(oldest);
            dropped += 1;
        }
        inner.jobs.push_back(job);
        self.arrived.notify_one();
        dropped
    }

    /// The mapping thread's side: the next job, or `None` once the queue is closed.
    pub fn pop(&self) -> Option<Job> {
        let mut inner = self.lock();
        inner.in_work = false;
        loop {
            if inner.closed {
                return None;
            }
            if let Some(job) = inner.jobs.pop_front() {
                inner.in_work = true;
                self.left.notify_waiters();
                return Some(job);
            }
            inner = self.arrived.wait(inner).unwrap_or_else(PoisonError::into_inner);
        }
    }

    /// Jobs that wait or are in work.
    pub fn pending(&self) -> usize {
        let inner = self.lock();
        inner.jobs.len() + inner.in_work as usize
    }

    /// No more jobs are taken or given.
    pub fn close(&self) {
        self.lock().closed = true;
        self.arrived.notify_all();
        self.left.notify_waiters();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use coma_frame::{DepthNoise, Image};
    use coma_geometry::{Intrinsics, StampNs};

    fn job(sequence: u64) -> Job {
        let camera = Intrinsics { width: 8, height: 8, fx: 8.0, fy: 8.0, cx: 3.5, cy: 3.5 };
        let (color, depth) = (Image::filled(8, 8, [0; 3]), Image::filled(8, 8, 1.0));
        let frame =
            RgbdFrame::new(sequence, StampNs(0), camera, DepthNoise::default(), color, depth).unwrap();
        Job::Frame { frame: Arc::new(frame), map: true, step_budget: 1 }
    }

    fn sequence(job: Option<Job>) -> u64 {
        match job {
            Some(Job::Frame { frame, .. }) => frame.sequence,
            _ => panic!("a frame was expected"),
        }
    }

    #[test]
    fn latest_drops_the_oldest_and_counts_it() {
        let queue = FrameQueue::new(2);
        let dropped: u64 = (0..5).map(|i| queue.push_dropping(job(i))).sum();
        assert_eq!(dropped, 3);
        assert_eq!([sequence(queue.pop()), sequence(queue.pop())], [3, 4]);
    }

    #[tokio::test]
    async fn block_waits_for_room_and_drops_nothing() {
        let queue = Arc::new(FrameQueue::new(1));
        assert!(queue.push_waiting(job(0)).await);
        let second = tokio::spawn({
            let queue = queue.clone();
            async move { queue.push_waiting(job(1)).await }
        });
        assert_eq!(sequence(queue.pop()), 0);
        assert!(second.await.unwrap());
        assert_eq!(sequence(queue.pop()), 1);
    }

    #[tokio::test]
    async fn a_closed_queue_lets_everyone_go() {
        let queue = FrameQueue::new(1);
        queue.close();
        assert!(!queue.push_waiting(job(0)).await);
        assert!(queue.pop().is_none());
    }
}

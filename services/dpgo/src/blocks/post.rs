//! Letters to one neighbour's dpgo: one waits at most, the newest; a neighbour that does not answer is tried again after
//! a while that grows.

use super::part::Heard;
use super::run::Run;
use coma_pose_graph::blocks::BlockId;
use coma_runtime::Channel;
use coma_wire::v1::dpgo_client::DpgoClient;
use coma_wire::{Message, v1};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;
use tokio::sync::Notify;
use tonic::{Code, Request, Status};

/// How long an answer may take.
const ANSWER: Duration = Duration::from_secs(2);
/// How long to wait after the first call without an answer,
const FIRST_WAIT: Duration = Duration::from_millis(20);
/// and at most.
const LONGEST_WAIT: Duration = Duration::from_secs(1);

/// A message on its way.
pub struct Letter {
    /// What it says.
    pub request: v1::PutBoundaryRequest,
    /// The version of the standings that it holds.
    pub version: u64,
}

/// Where a neighbour's next letter waits.
#[derive(Default)]
pub struct Slot {
    waiting: Mutex<Option<Letter>>,
    wake: Notify,
}

impl Slot {
    /// Replaces what waits. A boundary that waits goes with a letter that has none.
    pub fn put(&self, mut letter: Letter) {
        let mut waiting = self.waiting.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(older) = waiting.take()
            && letter.request.boundary.is_none()
            && older.request.attempt == letter.request.attempt
        {
            letter.request.boundary = older.request.boundary;
        }
        *waiting = Some(letter);
        self.wake.notify_one();
    }

    async fn next(&self) -> Letter {
        loop {
            let letter = self.waiting.lock().unwrap_or_else(PoisonError::into_inner).take();
            match letter {
                Some(letter) => return letter,
                None => self.wake.notified().await,
            }
        }
    }
}

/// Carries letters until it is dropped.
pub async fn carry(run: Arc<Run>, to: BlockId, slot: Arc<Slot>, mut client: DpgoClient<Channel>) {
    let mut wait = FIRST_WAIT;
    loop {
        let Letter { request, version } = slot.next().await;
        let (attempt, bytes) = (request.attempt, request.encoded_len() as u64);
        metrics::counter!("coma_dpgo_boundary_messages_total").increment(1);
        metrics::counter!("coma_dpgo_boundary_bytes_total").increment(bytes);
        let mut request = Request::new(request);
        request.set_timeout(ANSWER);
        match client.put_boundary(request).await {
            Ok(response) => {
                wait = FIRST_WAIT;
                let theirs = response.into_inner().attempt;
                run.answered(to, (attempt, version));
                if theirs > attempt && theirs <= super::MAX_ATTEMPT {
                    run.heard(to, Heard { attempt: theirs, ..Heard::default() });
                }
            }
            Err(status) => {
                metrics::counter!("coma_dpgo_boundary_failures_total").increment(1);
                run.unanswered(to, &reason(&status), status.code() == Code::NotFound);
                tokio::time::sleep(wait).await;
                wait = (2 * wait).min(LONGEST_WAIT);
            }
        }
    }
}

fn reason(status: &Status) -> String {
    let text = format!("{}: {}", status.code(), status.message());
    text.chars().take(200).collect()
}

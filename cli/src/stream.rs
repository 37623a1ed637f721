//! Plays a sequence into an agent over gRPC, as a robot would: frames out, acks in, and again from where the
//! agent wants it when the connection breaks.

use crate::source::Source;
use anyhow::{Context, anyhow, bail};
use coma_dataset::{ColorBytes, DepthBytes, RawFrame, Sequence};
use coma_runtime::Channel;
use coma_wire::v1::agent_client::AgentClient;
use coma_wire::v1::stream_frames_response::Event;
use coma_wire::{Calibration, ColorData, DepthData, EncodedFrame, Wire, encode_frame, v1};
use indicatif::ProgressBar;
use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;

/// How a sequence is played.
#[derive(Clone, Debug)]
pub struct StreamOptions {
    /// Name of the session; the same name goes on where an earlier life of it ended.
    pub session_id: String,
    /// What happens to a frame that finds the queue full.
    pub policy: v1::QueuePolicy,
    /// Every k-th frame is tracked, never mapped; 0: none.
    pub hold_out_every: u32,
    /// Frames per second; none: as fast as the agent takes them.
    pub rate_fps: Option<f64>,
    /// How long an agent may be away before the sequence is given up.
    pub patience: Duration,
}

impl Default for StreamOptions {
    fn default() -> Self {
        StreamOptions {
            session_id: "stream".into(),
            policy: v1::QueuePolicy::Block,
            hold_out_every: 0,
            rate_fps: None,
            patience: Duration::from_secs(30),
        }
    }
}

/// What the agent said of the frames.
#[derive(Clone, Debug, Default)]
pub struct Streamed {
    /// Frames that the agent took.
    pub frames: u64,
    /// Frames that it dropped under `latest`.
    pub dropped: u64,
    /// Frames that it refused, with its reason.
    pub refused: Vec<String>,
    /// Wall seconds of each processed frame that was acknowledged, by stage.
    pub frame_seconds: BTreeMap<String, Vec<f64>>,
}

type Shared = Arc<Mutex<Box<dyn Sequence>>>;

/// Plays all of `source` into the agent behind `channel`, and closes the session.
pub async fn stream(
    source: Source,
    channel: Channel,
    options: &StreamOptions,
    progress: &ProgressBar,
) -> anyhow::Result<Streamed> {
    let limit = coma_runtime::ClientSettings::default().max_message_bytes;
    let mut client = coma_wire::Limited::limited(AgentClient::new(channel), limit);
    let calibration = calibration(&*source.sequence);
    let length = source.sequence.len() as u64;
    let sequence: Shared = Arc::new(Mutex::new(source.sequence));
    let mut streamed = Streamed::default();
    let mut away_since: Option<Instant> = None;
    loop {
        let from = match open(&mut client, &calibration, options).await {
            Ok(next) => next,
            Err(e) => {
                wait(&mut away_since, options, e).await?;
                continue;
            }
        };
        progress.set_position(from);
        if from >= length {
            break;
        }
        match play(&sequence, from, length, &mut client, options, &mut streamed, progress).await {
            Ok(true) => break,
            Ok(false) => wait(&mut away_since, options, anyhow!("the agent ended the stream")).await?,
            Err(e) if e.is::<coma_dataset::DatasetError>() => return Err(e),
            Err(e) => wait(&mut away_since, options, e).await?,
        }
        if progress.position() > from {
            away_since = None;
        }
    }
    let close = v1::CloseSessionRequest { session_id: options.session_id.clone() };
    client.close_session(close).await.map_err(plain).context("the session could not be closed")?;
    streamed.frames = length - streamed.refused.len() as u64 - streamed.dropped;
    Ok(streamed)
}

/// Waits a little for an agent that is away; gives up when it was away for too long, or refuses what it is told.
async fn wait(
    since: &mut Option<Instant>,
    options: &StreamOptions,
    error: anyhow::Error,
) -> anyhow::Result<()> {
    let refused = error.downcast_ref::<tonic::Status>().is_some_and(|status| {
        use tonic::Code::*;
        matches!(
            status.code(),
            InvalidArgument | FailedPrecondition | Unauthenticated | PermissionDenied | OutOfRange
        )
    });
    if refused {
        return Err(plain_error(error));
    }
    let begin = *since.get_or_insert_with(Instant::now);
    if begin.elapsed() > options.patience {
        return Err(plain_error(error)
            .context(format!("the agent was away for {:.0} s", options.patience.as_secs_f64())));
    }
    tokio::time::sleep(Duration::from_millis(300)).await;
    Ok(())
}

async fn open(
    client: &mut AgentClient<Channel>,
    calibration: &v1::Calibration,
    options: &StreamOptions,
) -> anyhow::Result<u64> {
    let request = v1::OpenSessionRequest {
        session_id: options.session_id.clone(),
        calibration: Some(*calibration),
        policy: options.policy.into(),
        clock_domain: v1::ClockDomain::Device.into(),
        hold_out_every: options.hold_out_every,
    };
    Ok(client.open_session(request).await?.into_inner().next_sequence)
}

/// Plays frames from `from` on; true once all were sent and the agent has ended its answers in order.
async fn play(
    sequence: &Shared,
    from: u64,
    length: u64,
    client: &mut AgentClient<Channel>,
    options: &StreamOptions,
    streamed: &mut Streamed,
    progress: &ProgressBar,
) -> anyhow::Result<bool> {
    let (out, frames) = mpsc::channel(4);
    let (session_id, rate_fps) = (options.session_id.clone(), options.rate_fps);
    let reading = sequence.clone();
    let reader = tokio::task::spawn_blocking(move || -> anyhow::Result<()> {
        let begin = Instant::now();
        for index in from..length {
            let frame = {
                let sequence = reading.lock().unwrap_or_else(PoisonError::into_inner);
                let raw = sequence.frame(index as usize)?;
                encode_frame(encoded(raw, index, sequence.stamp(index as usize)))
            };
            if let Some(fps) = rate_fps {
                let due = Duration::from_secs_f64((index - from) as f64 / fps.max(1e-3));
                #[allow(
                    clippy::disallowed_methods,
                    reason = "a thread that may block plays at the camera's pace"
                )]
                std::thread::sleep(due.saturating_sub(begin.elapsed()));
            }
            let message = v1::StreamFramesRequest { session_id: session_id.clone(), frame: Some(frame) };
            if out.blocking_send(message).is_err() {
                return Ok(());
            }
        }
        Ok(())
    });
    let mut answers = client.stream_frames(ReceiverStream::new(frames)).await?.into_inner();
    loop {
        let answer = match answers.message().await {
            Ok(Some(answer)) => answer,
            Ok(None) => break,
            Err(status) => {
                drop(answers);
                // A frame that can't be read is the sequence's fault, not the agent's.
                reader.await??;
                return Err(status.into());
            }
        };
        match answer.event {
            Some(Event::Ack(ack)) => {
                streamed.dropped = ack.dropped_frames;
                if let Some(through) = ack.processed_through {
                    progress.set_position(through + 1);
                    for (stage, seconds) in [("tracking", ack.tracking_s), ("mapping", ack.mapping_s)] {
                        streamed.frame_seconds.entry(stage.into()).or_default().push(seconds);
                    }
                }
                if let Some(state) = ack.pose.map(|pose| pose.state()) {
                    let message =
                        if state == v1::TrackingState::Degraded { "tracking is degraded" } else { "" };
                    progress.set_message(message);
                } else {
                    progress.set_message("no pose");
                }
            }
            Some(Event::Refusal(refusal)) => {
                streamed
                    .refused
                    .push(format!("frame {}: {}: {}", refusal.sequence, refusal.field, refusal.message));
            }
            None => {}
        }
    }
    reader.await??;
    Ok(true)
}

/// What a session is told of its sensor.
pub fn calibration(sequence: &dyn Sequence) -> v1::Calibration {
    let c = sequence.calibration();
    let own_camera = !c.depth_is_registered();
    Calibration {
        depth: own_camera.then_some(c.depth),
        color_distortion: c.color_distortion,
        depth_distortion: c.depth_distortion,
        color_from_depth: c.color_from_depth,
        depth_noise: c.noise,
        depth_min_m: c.depth_min_m,
        depth_max_m: c.depth_max_m.is_finite().then_some(c.depth_max_m),
        ..Calibration::registered(c.color, c.depth_units_per_metre)
    }
    .to_wire()
}

fn encoded(raw: RawFrame, index: u64, stamp: coma_geometry::StampNs) -> EncodedFrame {
    let color = match raw.color {
        ColorBytes::Jpeg(bytes) => ColorData::Jpeg(bytes.into()),
        ColorBytes::Png(bytes) => ColorData::Png(bytes.into()),
        ColorBytes::Rgb8(image) => ColorData::Rgb8(image.into_pixels().into_flattened().into()),
    };
    let depth = match raw.depth {
        DepthBytes::Png16(bytes) => DepthData::Png16(bytes.into()),
        DepthBytes::Raw16(image) => {
            let bytes: Vec<u8> = image.pixels().iter().flat_map(|v| v.to_le_bytes()).collect();
            DepthData::Raw16(bytes.into())
        }
    };
    EncodedFrame { sequence: index, stamp, color, depth }
}

/// A status without its metadata.
pub fn plain(status: tonic::Status) -> anyhow::Error {
    anyhow!("{:?}: {}", status.code(), status.message())
}

fn plain_error(error: anyhow::Error) -> anyhow::Error {
    match error.downcast::<tonic::Status>() {
        Ok(status) => plain(status),
        Err(error) => error,
    }
}

/// A name that may be a session's: lower-case letters, digits and '-'.
pub fn checked_session(name: &str) -> anyhow::Result<()> {
    if name.is_empty() || coma_wire::session_id(name, &coma_wire::At::Root("session")).is_err() {
        bail!("--session {name:?}: 1 to 64 characters of a-z, 0-9 and '-' are needed");
    }
    Ok(())
}

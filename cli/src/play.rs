//! `coma stream`: plays a sequence into a running agent.

use crate::fault;
use crate::stream::{StreamOptions, checked_session, plain, stream};
use crate::{progress, source};
use anyhow::bail;
use clap::{Args, ValueEnum};
use coma_runtime::{ByteLedger, Class, ClientSettings, Secret, channel};
use coma_wire::v1;
use std::time::Duration;

/// Plays a recorded sequence into a running agent, as a robot would stream it.
///
///   coma stream tum:kitchen --to http://127.0.0.1:7001
///   coma stream world:rooms/agent-0 --to http://127.0.0.1:7001 --policy latest --rate 30
///
/// When the agent goes away, frames are sent again from where it wants them once it is back.
#[derive(Args)]
pub struct Arguments {
    /// [NAME=]FORMAT:DIR[first:last:stride,...], as for `coma run`.
    spec: String,
    /// The agent, `http://host:port`.
    #[arg(long)]
    to: String,
    /// What happens to a frame that finds the agent's queue full.
    #[arg(long, value_enum, default_value_t = Policy::Block)]
    policy: Policy,
    /// Frames per second; default: as fast as the agent takes them.
    #[arg(long)]
    rate: Option<f64>,
    /// Name of the session; the same name goes on where an earlier stream of it ended.
    #[arg(long, default_value = "stream")]
    session: String,
    /// Every K-th frame is tracked, never mapped.
    #[arg(long, value_name = "K", default_value_t = 0)]
    hold_out: u32,
    /// Spoils frames on purpose: blackout:100-129 or nodepth:100-129, both ends included.
    #[arg(long)]
    fault: Vec<fault::Fault>,
    /// Bearer token of the agent.
    #[arg(long, env = "COMA_TOKEN", hide_env_values = true)]
    token: Option<String>,
    /// Seconds that the agent may be away before the stream is given up.
    #[arg(long, default_value_t = 30.0)]
    patience: f64,
}

/// What happens to a frame that finds the queue full.
#[derive(Clone, Copy, ValueEnum)]
enum Policy {
    /// The stream waits: nothing is dropped.
    Block,
    /// The oldest waiting frame is dropped.
    Latest,
}

/// Runs it.
pub async fn run(arguments: Arguments) -> anyhow::Result<()> {
    checked_session(&arguments.session)?;
    if arguments.rate.is_some_and(|fps| !(fps > 0.0 && fps.is_finite())) {
        bail!("--rate must be over 0");
    }
    let mut sources = source::open(std::slice::from_ref(&arguments.spec))?;
    if sources.len() != 1 {
        bail!("{} holds {} agents' sequences; name the folder of one", arguments.spec, sources.len());
    }
    let mut source = sources.remove(0);
    source.sequence = fault::spoil(source.sequence, &arguments.fault);
    let settings = ClientSettings { token: arguments.token.map(Secret::new), ..ClientSettings::default() };
    let channel = channel(&arguments.to, &settings, &ByteLedger::default(), Class::Client)?;
    let options = StreamOptions {
        session_id: arguments.session,
        policy: match arguments.policy {
            Policy::Block => v1::QueuePolicy::Block,
            Policy::Latest => v1::QueuePolicy::Latest,
        },
        hold_out_every: arguments.hold_out,
        rate_fps: arguments.rate,
        patience: Duration::from_secs_f64(arguments.patience.clamp(0.0, 1e6)),
    };
    let bar = progress::frames(&source.agent, source.sequence.len() as u64);
    let streamed = stream(source, channel.clone(), &options, &bar).await?;
    bar.finish_and_clear();
    let mut agent = coma_wire::v1::agent_client::AgentClient::new(channel);
    let status = agent.get_status(v1::GetStatusRequest {}).await.map_err(plain)?.into_inner();
    println!(
        "agent {}: {} frames taken, {} dropped, {} refused; {} submaps, {} surfels",
        status.agent_id,
        streamed.frames,
        streamed.dropped,
        streamed.refused.len(),
        status.submaps,
        status.surfels
    );
    for refused in streamed.refused.iter().take(20) {
        println!("refused: {refused}");
    }
    Ok(())
}

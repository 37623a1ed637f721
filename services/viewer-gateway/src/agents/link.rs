//! One agent: a channel to it, and what it last said of itself.

use super::events::{LiveEvent, live_event};
use crate::config::GatewayConfig;
use coma_geometry::AgentId;
use coma_runtime::{ByteLedger, CancellationToken, Channel, ChannelError, Class, channel};
use coma_wire::v1::agent_client::AgentClient;
use coma_wire::v1::viewer_client::ViewerClient;
use coma_wire::{Limited, v1};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;
use tokio::sync::{broadcast, watch};
use tonic::Status;

/// What an agent last said, or why it did not.
#[derive(Clone, Debug, Default)]
pub struct LinkState {
    /// It was asked at least once, and answered or did not.
    pub asked: bool,
    /// It answered the last time.
    pub reachable: bool,
    /// Its name, once it said so.
    pub id: Option<AgentId>,
    /// The last status that it gave; old if it is not reachable now.
    pub status: Option<Arc<v1::GetStatusResponse>>,
    /// Why it is not reachable.
    pub error: String,
}

/// See the module.
pub struct Link {
    /// Where it is looked for.
    pub endpoint: String,
    /// Longest time for one answer to the end.
    pub call_timeout: Duration,
    channel: Channel,
    message_bytes: usize,
    state: Mutex<LinkState>,
    reachable: watch::Sender<bool>,
    gone: CancellationToken,
}

impl Link {
    /// Makes the channel and starts to follow the agent, until [`Link::forget`] or `stop`.
    pub fn open(
        endpoint: &str,
        config: &GatewayConfig,
        ledger: &ByteLedger,
        events: broadcast::Sender<LiveEvent>,
        stop: &CancellationToken,
    ) -> Result<Arc<Link>, ChannelError> {
        let channel = channel(endpoint, &config.client, ledger, Class::Client)?;
        let link = Arc::new(Link {
            endpoint: endpoint.to_owned(),
            call_timeout: Duration::from_secs_f64(config.call_timeout_s),
            channel,
            message_bytes: config.client.max_message_bytes,
            state: Mutex::default(),
            reachable: watch::channel(false).0,
            gone: stop.child_token(),
        });
        let every = Duration::from_secs_f64(config.status_every_s);
        let within = Duration::from_secs_f64(config.status_timeout_s);
        tokio::spawn(link.clone().until_gone(ask_status(link.clone(), every, within, events.clone())));
        tokio::spawn(link.clone().until_gone(follow_events(link.clone(), every, events)));
        Ok(link)
    }

    /// Ends following.
    pub fn forget(&self) {
        self.gone.cancel();
    }

    /// What it last said.
    pub fn state(&self) -> LinkState {
        self.state.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// A client of its Viewer service.
    pub fn viewer(&self) -> ViewerClient<Channel> {
        ViewerClient::new(self.channel.clone()).limited(self.message_bytes)
    }

    async fn until_gone(self: Arc<Self>, work: impl Future<Output = ()>) {
        self.gone.run_until_cancelled(work).await;
    }

    /// Notes an answer; true if anything that the list of agents shows at a glance has changed.
    fn note(&self, answer: Result<v1::GetStatusResponse, Status>) -> bool {
        let mut state = self.state.lock().unwrap_or_else(PoisonError::into_inner);
        let before = (state.asked, state.reachable, state.id.clone(), state.status.as_ref().map(|s| s.state));
        state.asked = true;
        let answer = answer.and_then(|status| match AgentId::new(&status.agent_id) {
            Ok(id) => Ok((id, status)),
            Err(e) => Err(Status::internal(format!("its answer is none: {e}"))),
        });
        match answer {
            Ok((id, status)) => {
                (state.reachable, state.id, state.error) = (true, Some(id), String::new());
                state.status = Some(Arc::new(status));
            }
            Err(status) => {
                state.reachable = false;
                state.error = plain(&status);
            }
        }
        self.reachable.send_replace(state.reachable);
        before != (state.asked, state.reachable, state.id.clone(), state.status.as_ref().map(|s| s.state))
    }
}

/// What people read of a status.
pub fn plain(status: &Status) -> String {
    let message = status.message();
    if message.is_empty() { status.code().description().to_owned() } else { message.to_owned() }
}

async fn ask_status(
    link: Arc<Link>,
    every: Duration,
    within: Duration,
    events: broadcast::Sender<LiveEvent>,
) {
    let mut client = AgentClient::new(link.channel.clone()).limited(link.message_bytes);
    loop {
        let answer = tokio::time::timeout(within, client.get_status(v1::GetStatusRequest {})).await;
        let answer = match answer {
            Ok(answer) => answer.map(tonic::Response::into_inner),
            Err(_) => Err(Status::deadline_exceeded(format!("no answer within {within:?}"))),
        };
        if link.note(answer) {
            // Nobody may be listening.
            let _ = events.send(LiveEvent::Agents {});
        }
        tokio::time::sleep(every).await;
    }
}

/// Passes the agent's events on for as long as it is there.
async fn follow_events(link: Arc<Link>, pause: Duration, events: broadcast::Sender<LiveEvent>) {
    let mut reachable = link.reachable.subscribe();
    loop {
        if reachable.wait_for(|reachable| *reachable).await.is_err() {
            return;
        }
        if let Ok(stream) = link.viewer().watch(v1::WatchRequest {}).await {
            let mut stream = stream.into_inner();
            // Events before this moment are not known here.
            let _ = events.send(LiveEvent::Again {});
            // A break, or a watcher that was too slow: states are asked for again.
            while let Ok(Some(message)) = stream.message().await {
                match message.event.map(live_event) {
                    Some(Ok(event)) => drop(events.send(event)),
                    Some(Err(e)) => {
                        tracing::warn!(endpoint = link.endpoint, error = %e, "an event can't be read")
                    }
                    // Of a kind that only newer gateways know.
                    None => {}
                }
            }
        }
        tokio::time::sleep(pause).await;
    }
}

//! What happens, as it happens.

use super::Gateway;
use crate::agents::LiveEvent;
use crate::error::{ApiError, Problem};
use axum::extract::State;
use axum::response::sse::{Event, KeepAlive, Sse};
use futures::{Stream, StreamExt, stream};
use std::convert::Infallible;
use std::sync::Arc;
use std::time::Duration;
use tokio_stream::wrappers::BroadcastStream;

/// Proxies close connections that are silent for longer.
const KEEP_ALIVE: Duration = Duration::from_secs(15);

/// Server-sent events of all agents from now on. Each has a kind (`again`, `agents`, `pose`, `submap`, `correction`,
/// `verdict`) and the same as `type` in its JSON. The first is `again`: get the states now. It comes once more when
/// a listener was too slow, or an agent came back.
#[utoipa::path(get, path = "/api/v1/events", tag = "events", security(("token" = [])),
    responses((status = 200, description = "The events", body = LiveEvent, content_type = "text/event-stream"),
              (status = 503, description = "Too many listeners", body = Problem)))]
pub async fn events(
    State(gateway): State<Arc<Gateway>>,
) -> Result<Sse<impl Stream<Item = Result<Event, Infallible>>>, ApiError> {
    let limit = gateway.config.max_listeners;
    let busy = |_| ApiError::busy(format!("{limit} listen already, the limit of this gateway"));
    let place = gateway.listeners.clone().try_acquire_owned().map_err(busy)?;
    let live = BroadcastStream::new(gateway.directory.events());
    // One that was too slow has missed some.
    let live = live.map(|event| event.unwrap_or(LiveEvent::Again {}));
    let events = stream::once(async { LiveEvent::Again {} }).chain(live).map(move |event| {
        let _held_while_it_listens = &place;
        let json = Event::default().event(event.kind()).json_data(&event);
        Ok(json.unwrap_or_else(|_| Event::default().event("again").data(r#"{"type":"again"}"#)))
    });
    let events = events.take_until(gateway.stop.clone().cancelled_owned());
    Ok(Sse::new(events).keep_alive(KeepAlive::new().interval(KEEP_ALIVE)))
}

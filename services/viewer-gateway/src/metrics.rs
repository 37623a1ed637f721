//! Prometheus' text: this process's own metrics, and what each agent says of itself.

use crate::agents::Link;
use std::fmt::Write;
use std::sync::Arc;

/// One family of metrics.
struct Family {
    name: &'static str,
    kind: &'static str,
    help: &'static str,
    /// Labels, each with its value, and the number.
    samples: Vec<(Vec<(&'static str, String)>, f64)>,
}

/// What agents say, and what the gateway keeps, as text.
pub fn of_agents(links: &[Arc<Link>], cache_bytes: usize) -> String {
    let family = |name, kind, help| Family { name, kind, help, samples: Vec::new() };
    let mut reachable =
        family("coma_agent_reachable", "gauge", "1 if the agent answered the last time it was asked.");
    let mut frames =
        family("coma_agent_frames_processed_total", "counter", "Frames that the agent has tracked.");
    let mut dropped =
        family("coma_agent_frames_dropped_total", "counter", "Frames that found the queue full.");
    let mut submaps = family("coma_agent_submaps", "gauge", "Submaps of the agent.");
    let mut surfels = family("coma_agent_surfels", "gauge", "Surfels of the agent.");
    let mut lost = family("coma_agent_tracking_lost", "gauge", "1 while the camera is lost.");
    let mut warnings = family("coma_agent_warnings", "gauge", "Things that the agent wants users to know.");
    let mut peers = family("coma_agent_peer_alive", "gauge", "1 if the agent reaches the peer.");
    let mut seconds = family("coma_agent_stage_seconds_total", "counter", "Wall seconds by stage.");
    let mut bytes = family(
        "coma_agent_sent_bytes_total",
        "counter",
        "Bytes that the agent wrote, by class and message type.",
    );
    let mut messages = family(
        "coma_agent_sent_messages_total",
        "counter",
        "Messages that the agent wrote, by class and type.",
    );
    for link in links {
        let state = link.state();
        let name = state.id.as_ref().map_or_else(|| link.endpoint.clone(), ToString::to_string);
        let agent = || vec![("agent", name.clone())];
        reachable.samples.push((agent(), f64::from(u8::from(state.reachable))));
        // Old numbers of an agent that is gone would read as a standstill.
        let Some(status) = state.status.filter(|_| state.reachable) else { continue };
        frames.samples.push((agent(), status.frames_processed as f64));
        dropped.samples.push((agent(), status.frames_dropped as f64));
        submaps.samples.push((agent(), f64::from(status.submaps)));
        surfels.samples.push((agent(), status.surfels as f64));
        let is_lost = status.state == coma_wire::v1::TrackingState::Lost as i32;
        lost.samples.push((agent(), f64::from(u8::from(is_lost))));
        warnings.samples.push((agent(), status.warnings.len() as f64));
        for peer in &status.peers {
            let labels = vec![
                ("agent", name.clone()),
                ("peer", peer.agent_id.clone()),
                ("endpoint", peer.endpoint.clone()),
            ];
            peers.samples.push((labels, f64::from(u8::from(peer.alive))));
        }
        for (stage, total) in &status.stage_seconds {
            seconds.samples.push((vec![("agent", name.clone()), ("stage", stage.clone())], *total));
        }
        for sent in &status.bytes_sent {
            let labels = vec![
                ("agent", name.clone()),
                ("class", sent.class.clone()),
                ("message_type", sent.message_type.clone()),
            ];
            bytes.samples.push((labels.clone(), sent.bytes as f64));
            messages.samples.push((labels, sent.messages as f64));
        }
    }
    let mut kept = family("coma_gateway_cache_bytes", "gauge", "Bytes of closed submaps that are kept.");
    kept.samples.push((Vec::new(), cache_bytes as f64));
    let families =
        [reachable, frames, dropped, submaps, surfels, lost, warnings, peers, seconds, bytes, messages, kept];
    let mut text = String::new();
    families.iter().for_each(|family| write_family(family, &mut text));
    text
}

fn write_family(family: &Family, text: &mut String) {
    let Family { name, kind, help, samples } = family;
    // Writing to a string can't fail.
    let _ = writeln!(text, "# HELP {name} {help}\n# TYPE {name} {kind}");
    for (labels, value) in samples {
        let labels: Vec<String> =
            labels.iter().map(|(label, value)| format!("{label}=\"{}\"", escaped(value))).collect();
        let labels = if labels.is_empty() { String::new() } else { format!("{{{}}}", labels.join(",")) };
        let _ = writeln!(text, "{name}{labels} {value}");
    }
}

/// As the text format has it; other control characters can't break a line.
fn escaped(value: &str) -> String {
    value.replace('\\', "\\\\").replace('"', "\\\"").replace('\n', "\\n")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn labels_are_escaped_and_families_are_described() {
        let samples = vec![(vec![("agent", "a\"b\\c\nd".to_owned())], 3.0)];
        let family = Family { name: "x_total", kind: "counter", help: "Xs.", samples };
        let mut text = String::new();
        write_family(&family, &mut text);
        assert_eq!(
            text,
            "# HELP x_total Xs.\n# TYPE x_total counter\nx_total{agent=\"a\\\"b\\\\c\\nd\"} 3\n"
        );
    }
}

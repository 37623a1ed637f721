//! The frames that a map is refined by, read ahead of their steps.

use crate::eval;
use crate::fault;
use crate::run::facts::Facts;
use crate::run::faults;
use crate::source::{self, Source};
use anyhow::{Context, bail};
use coma_dataset::Sequence;
use coma_frame::RgbdFrame;
use coma_geometry::Pose;
use std::path::Path;
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::sync::{Arc, Mutex};

/// One of them.
pub struct View {
    /// Index in [`Views::sequences`].
    source: usize,
    /// Index in its sequence.
    pub frame: usize,
    map_from_camera: Pose,
}

/// Agents' names and what they saw.
type Sequences = Vec<(String, Box<dyn Sequence>)>;

/// Frames that are asked for and not yet taken: the one that is needed and the one after.
const AHEAD: usize = 2;

/// All of them, agent by agent.
pub struct Views {
    /// In the order of the job's views.
    pub of: Vec<View>,
    sequences: Arc<Mutex<Sequences>>,
    names: Vec<String>,
}

impl Views {
    /// Every frame of a component that has a pose and was not held out; with `only`, those of one agent, and the
    /// sequences and trajectories of others are not opened.
    pub fn open(run: &Path, facts: &Facts, component: usize, only: Option<&str>) -> anyhow::Result<Self> {
        let names: Vec<String> = facts.agents.iter().map(|a| a.name.clone()).collect();
        let (mut of, mut sequences) = (Vec::new(), Vec::new());
        for (agent, known) in facts.agents.iter().enumerate() {
            let here = known.poses.iter().any(|p| p.component == component);
            if !here || only.is_some_and(|only| only != known.name) {
                continue;
            }
            let spoilt = faults(&known.faults, &names)?;
            let sequence = fault::spoil(open(facts, agent)?.sequence, &spoilt[agent]);
            for (frame, map_from_camera) in eval::track(run, facts, agent, component, &*sequence)? {
                if !facts.is_held_out(agent, frame) {
                    of.push(View { source: sequences.len(), frame, map_from_camera });
                }
            }
            sequences.push((known.name.clone(), sequence));
        }
        if of.is_empty() {
            bail!("{}: no frame to refine by", run.display());
        }
        let names = sequences.iter().map(|(name, _)| name.clone()).collect();
        Ok(Views { of, sequences: Arc::new(Mutex::new(sequences)), names })
    }

    /// Where the run saw them.
    pub fn poses(&self) -> Vec<Pose> {
        self.of.iter().map(|v| v.map_from_camera).collect()
    }

    /// Whose it is.
    pub fn agent(&self, view: &View) -> &str {
        &self.names[view.source]
    }

    /// Begins to read `first`.
    pub fn reader(&self, first: Option<usize>) -> anyhow::Result<Reader> {
        let (ask, asked) = sync_channel::<(usize, usize)>(AHEAD);
        let (give, given) = sync_channel(AHEAD);
        let sequences = self.sequences.clone();
        std::thread::Builder::new().name("frames".into()).spawn(move || {
            let Ok(sequences) = sequences.lock() else { return };
            for (source, frame) in asked {
                let (name, sequence) = &sequences[source];
                let read = coma_dataset::sequence::rgbd_frame(&**sequence, frame)
                    .with_context(|| format!("{name}, frame {frame}"));
                if give.send(read).is_err() {
                    return;
                }
            }
        })?;
        let at = self.of.iter().map(|v| (v.source, v.frame)).collect();
        let reader = Reader { ask, given, at };
        reader.ask(first);
        Ok(reader)
    }
}

/// Reads one frame ahead.
pub struct Reader {
    ask: SyncSender<(usize, usize)>,
    given: Receiver<anyhow::Result<RgbdFrame>>,
    at: Vec<(usize, usize)>,
}

impl Reader {
    /// The frame that was asked for; `then` is read meanwhile.
    pub fn next(&self, then: Option<usize>) -> anyhow::Result<RgbdFrame> {
        self.ask(then);
        self.given.recv().context("the reader of frames stopped")?
    }

    fn ask(&self, view: Option<usize>) {
        if let Some(view) = view {
            // Where the reader has stopped, the next `recv` says so.
            let _ = self.ask.send(self.at[view]);
        }
    }
}

/// One agent's sequence, without those of others. Agents that are not named by their spec are numbered in the order of
/// all specs; a folder of several agents makes several.
fn open(facts: &Facts, agent: usize) -> anyhow::Result<Source> {
    let spec = &facts.agents[agent].spec;
    let mut opened = source::open(std::slice::from_ref(spec))?;
    let before = facts.agents[..agent].iter().filter(|a| a.spec == *spec).count();
    let index = before % opened.len().max(1);
    if index >= opened.len() {
        bail!("{spec}: nothing to open for agent {}", facts.agents[agent].name);
    }
    Ok(opened.swap_remove(index))
}

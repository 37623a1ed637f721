//! Naming a sequence: `[NAME=]FORMAT:PATH[first:last:stride,...]`.

use crate::world::{SensorNoise, World, WorldSettings};
use crate::{Calibration, DatasetError, RawFrame, Sequence, multi_agent, replica, seven_scenes, tum};
use coma_geometry::{AgentId, Pose, StampNs};
use std::fmt;
use std::path::{Path, PathBuf};
use std::str::FromStr;

/// How a sequence lies on disk.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Format {
    /// TUM RGB-D: rgb/, depth/, associations.txt or rgb.txt and depth.txt, groundtruth.txt,
    /// calibration.txt.
    Tum,
    /// Replica as rendered for iMAP and NICE-SLAM: traj.txt, results/frame*.jpg, results/depth*.png.
    Replica,
    /// 7-Scenes: frame-XXXXXX.color.png, .depth.png, .pose.txt.
    SevenScenes,
    /// A folder with one folder per agent, each in the layout of Replica.
    ReplicaMultiAgent,
    /// The same with the cameras of Aria.
    AriaMultiAgent,
    /// The built-in world; the path is `rooms/agent-K` or `noisy-rooms/agent-K`.
    World,
}

const FORMATS: [(&str, Format); 6] = [
    ("tum", Format::Tum),
    ("replica", Format::Replica),
    ("7scenes", Format::SevenScenes),
    ("replica-multiagent", Format::ReplicaMultiAgent),
    ("aria-multiagent", Format::AriaMultiAgent),
    ("world", Format::World),
];

/// Which frames: `first..last`, every `stride`-th. What wasn't said is `None`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct FrameRange {
    /// First frame; 0 if unsaid.
    pub first: Option<usize>,
    /// One after the last frame; the end if unsaid.
    pub last: Option<usize>,
    /// Step; 1 if unsaid.
    pub stride: Option<usize>,
}

/// A sequence by name.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Spec {
    /// The agent's name, if given.
    pub name: Option<String>,
    /// How it lies on disk.
    pub format: Format,
    /// Where.
    pub path: PathBuf,
    /// Which frames, joined in this order; all if empty.
    pub ranges: Vec<FrameRange>,
}

/// Why a text is no [`Spec`], or a range doesn't fit its sequence.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{at:?} in {spec:?}: {needed}")]
pub struct SpecError {
    /// The whole spec.
    pub spec: String,
    /// The text at fault.
    pub at: String,
    /// What was expected there.
    pub needed: String,
}

impl FromStr for Spec {
    type Err = SpecError;

    fn from_str(text: &str) -> Result<Self, SpecError> {
        let error = |at: &str, needed: &str| SpecError {
            spec: text.to_owned(),
            at: at.to_owned(),
            needed: needed.to_owned(),
        };
        let head_end = text.find(':').unwrap_or(text.len());
        let (name, rest) = match text[..head_end].find('=') {
            Some(i) => {
                let name = &text[..i];
                AgentId::new(name).map_err(|e| error(name, &e.to_string()))?;
                (Some(name.to_owned()), &text[i + 1..])
            }
            None => (None, text),
        };
        let known = "one of tum, replica, 7scenes, replica-multiagent, aria-multiagent, world, and ':'";
        let (format_text, rest) = rest.split_once(':').ok_or_else(|| error(rest, known))?;
        let format = FORMATS.iter().find(|(name, _)| *name == format_text);
        let format = format.ok_or_else(|| error(format_text, known))?.1;
        let (path, ranges) = match rest.strip_suffix(']') {
            Some(inner) => {
                let (path, list) =
                    inner.rsplit_once('[').ok_or_else(|| error(rest, "'[' before the ranges"))?;
                let ranges = list.split(',').map(|r| range(r).ok_or(r)).collect::<Result<Vec<_>, _>>();
                let needed = "first:last:stride with first < last and stride at least 1, or parts of it";
                (path, ranges.map_err(|r| error(r, needed))?)
            }
            None => (rest, Vec::new()),
        };
        if path.is_empty() {
            return Err(error(rest, "a folder after the format"));
        }
        if ranges.is_empty() && path.contains('[') {
            return Err(error(rest, "']' after the ranges"));
        }
        Ok(Spec { name, format, path: path.into(), ranges })
    }
}

/// `""`, `"5"` (one frame), `"first:last"` or `"first:last:stride"`, each part may be missing.
fn range(text: &str) -> Option<FrameRange> {
    let parts: Vec<&str> = text.split(':').map(str::trim).collect();
    let number = |s: &str| -> Option<Option<usize>> {
        if s.is_empty() {
            return Some(None);
        }
        s.bytes().all(|b| b.is_ascii_digit()).then(|| s.parse().ok())?.map(Some)
    };
    let range = match parts[..] {
        [""] => FrameRange::default(),
        [one] => {
            let first = number(one)??;
            FrameRange { first: Some(first), last: Some(first.checked_add(1)?), stride: None }
        }
        [first, last] => FrameRange { first: number(first)?, last: number(last)?, stride: None },
        [first, last, stride] => {
            FrameRange { first: number(first)?, last: number(last)?, stride: number(stride)? }
        }
        _ => return None,
    };
    let ordered = range.last.is_none_or(|last| range.first.unwrap_or(0) < last);
    (ordered && range.stride != Some(0)).then_some(range)
}

impl fmt::Display for Spec {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if let Some(name) = &self.name {
            write!(f, "{name}=")?;
        }
        let format = FORMATS.iter().find(|(_, format)| *format == self.format).map_or("", |(name, _)| name);
        write!(f, "{format}:{}", self.path.display())?;
        if !self.ranges.is_empty() {
            let number = |n: Option<usize>| n.map_or(String::new(), |n| n.to_string());
            let ranges: Vec<String> = self
                .ranges
                .iter()
                .map(|r| {
                    let stride = r.stride.map_or(String::new(), |s| format!(":{s}"));
                    format!("{}:{}{stride}", number(r.first), number(r.last))
                })
                .collect();
            write!(f, "[{}]", ranges.join(","))?;
        }
        Ok(())
    }
}

/// Opens one sequence. A multi-agent folder is opened by its agent's own folder here, and as a whole by
/// [`open_all`].
pub fn open(spec: &Spec) -> Result<Box<dyn Sequence>, DatasetError> {
    let whole: Box<dyn Sequence> = match spec.format {
        Format::Tum => Box::new(tum::open(&spec.path)?),
        Format::Replica => Box::new(replica::open(&spec.path, &replica::REPLICA)?),
        Format::SevenScenes => Box::new(seven_scenes::open(&spec.path)?),
        Format::ReplicaMultiAgent => Box::new(replica::open(&spec.path, &replica::REPLICA)?),
        Format::AriaMultiAgent => Box::new(replica::open(&spec.path, &replica::ARIA)?),
        Format::World => Box::new(open_world(spec)?),
    };
    restrict(spec, whole)
}

/// An agent's name and what it sees.
pub type NamedSequence = (String, Box<dyn Sequence>);

/// Opens every agent that a spec names: one for a single sequence, one per folder for a multi-agent
/// folder. Names are the spec's (with `-0`, `-1`, ... where there are several), else the folder's.
pub fn open_all(spec: &Spec) -> Result<Vec<NamedSequence>, DatasetError> {
    let camera = match spec.format {
        Format::ReplicaMultiAgent => &replica::REPLICA,
        Format::AriaMultiAgent => &replica::ARIA,
        _ => {
            let name = spec.name.clone().unwrap_or_else(|| agent_name(&spec.path));
            return Ok(vec![(name, open(spec)?)]);
        }
    };
    let folders = multi_agent::agent_folders(&spec.path)?;
    let several = folders.len() > 1;
    folders
        .iter()
        .enumerate()
        .map(|(i, folder)| {
            let name = match &spec.name {
                Some(name) if several => format!("{name}-{i}"),
                Some(name) => name.clone(),
                None => agent_name(folder),
            };
            Ok((name, restrict(spec, Box::new(replica::open(folder, camera)?))?))
        })
        .collect()
}

/// A folder's name with everything that an agent's name may not have replaced by '-'.
fn agent_name(folder: &Path) -> String {
    let name = folder.file_name().map_or(String::new(), |n| n.to_string_lossy().to_lowercase());
    let allowed = |c: char| if c.is_ascii_lowercase() || c.is_ascii_digit() { c } else { '-' };
    let name: String = name.chars().map(allowed).take(64).collect();
    let name = name.trim_start_matches('-');
    if name.is_empty() { "agent".to_owned() } else { name.to_owned() }
}

fn open_world(spec: &Spec) -> Result<crate::world::WorldSequence, DatasetError> {
    let text = spec.path.to_string_lossy().into_owned();
    let unknown = || DatasetError::UnknownWorld {
        name: text.clone(),
        needed: "there are rooms/agent-0 to rooms/agent-7 and noisy-rooms/agent-0 to noisy-rooms/agent-7",
    };
    let (place, agent) = text.split_once("/agent-").ok_or_else(unknown)?;
    let agent: usize = agent.parse().map_err(|_| unknown())?;
    let noise = match place {
        "rooms" => None,
        "noisy-rooms" => Some(SensorNoise::default()),
        _ => return Err(unknown()),
    };
    if agent >= crate::world::tour::MAX_AGENTS {
        return Err(unknown());
    }
    let defaults = WorldSettings::default();
    let last = spec.ranges.iter().filter_map(|r| r.last).max();
    let frames = last.unwrap_or(0).max(defaults.frames);
    let world = World::new(WorldSettings { agents: agent + 1, frames, noise, ..defaults })?;
    world.sequence(agent).ok_or_else(unknown)
}

/// Some frames of a sequence.
struct Selection {
    whole: Box<dyn Sequence>,
    /// Index in `whole` of each frame.
    frames: Vec<usize>,
}

fn restrict(spec: &Spec, whole: Box<dyn Sequence>) -> Result<Box<dyn Sequence>, DatasetError> {
    if spec.ranges.is_empty() {
        return Ok(whole);
    }
    let len = whole.len();
    let mut frames = Vec::new();
    for r in &spec.ranges {
        let (first, last) = (r.first.unwrap_or(0), r.last.unwrap_or(len));
        if first >= len || last > len {
            let at = FrameRange { first: Some(first), last: Some(last), stride: r.stride };
            let at = Spec { ranges: vec![at], ..spec.clone() }.to_string();
            let at = at.rsplit_once('[').map_or("", |(_, list)| list.trim_end_matches(']')).to_owned();
            let needed = format!("a range within the sequence's {len} frames");
            return Err(SpecError { spec: spec.to_string(), at, needed }.into());
        }
        frames.extend((first..last).step_by(r.stride.unwrap_or(1)));
    }
    Ok(Box::new(Selection { whole, frames }))
}

impl Sequence for Selection {
    fn calibration(&self) -> &Calibration {
        self.whole.calibration()
    }

    fn len(&self) -> usize {
        self.frames.len()
    }

    fn stamp_text(&self, index: usize) -> &str {
        self.whole.stamp_text(self.frames[index])
    }

    fn stamp(&self, index: usize) -> StampNs {
        self.whole.stamp(self.frames[index])
    }

    fn frame(&self, index: usize) -> Result<RawFrame, DatasetError> {
        let frame = self.frames.get(index).ok_or(DatasetError::NoSuchFrame { index, len: self.len() })?;
        self.whole.frame(*frame)
    }

    fn truth(&self, index: usize) -> Option<Pose> {
        self.whole.truth(*self.frames.get(index)?)
    }
}

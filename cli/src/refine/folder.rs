//! What refinement leaves in a run's folder, below `refined/`: a map beside the run's own, and what it was made from.

use crate::run::facts::{Facts, SubmapFacts};
use crate::run::{write_atomically, write_in_pieces};
use anyhow::{Context, bail};
use coma_geometry::Pose;
use coma_raster::RenderSettings;
use coma_slam::mapping::refine::RefineSettings;
use coma_surfel::SurfelCloud;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::fs::File;
use std::io::BufReader;
use std::ops::Range;
use std::path::{Path, PathBuf};

/// Surfels that a map may have when it is read back.
pub const MAX_SURFELS: usize = 50_000_000;
/// Bytes that a file with facts or a checkpoint may have.
const MAX_FILE_BYTES: u64 = 16 << 30;

/// Beside each refined map: what it was made from, and how it went.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct RefinedFacts {
    /// Name of the component.
    pub component: String,
    /// Of the poses that the map was merged by, in hexadecimal.
    pub digest: String,
    /// Surfels of the map that the run left.
    pub base_surfels: usize,
    /// Whose share it is; absent for a whole map.
    pub agent: Option<String>,
    /// As the job took them.
    pub settings: RefineSettings,
    /// Surfels in the refined map or share.
    pub surfels: usize,
    /// By the clock, of all its parts, frames read and checkpoints written.
    pub seconds: f64,
    /// On the way.
    pub progress: Vec<Progress>,
    /// Where the refined map sees the views.
    pub poses: Vec<RefinedPose>,
}

/// Means over the steps since the line before, each found before the step changed anything.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
pub struct Progress {
    /// Steps that were taken.
    pub step: u32,
    /// Of whole pictures.
    pub psnr_db: f64,
    /// Of whole pictures.
    pub ssim: f64,
    /// Where both have depth, metres.
    pub depth_l1_m: f64,
    /// Surfels that are refined.
    pub surfels: usize,
    /// Of one step, by the clock, reading its frame included.
    pub step_s: f64,
}

/// A view's pose.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct RefinedPose {
    /// Its agent.
    pub agent: String,
    /// Index in its agent's sequence.
    pub frame: usize,
    /// Refined.
    pub map_from_camera: Pose,
}

/// The files of one job.
pub struct Files {
    folder: PathBuf,
    stem: String,
}

impl Files {
    /// Those of a component's whole map, or of one agent's share of it.
    pub fn new(run: &Path, component: usize, agent: Option<&str>) -> Self {
        let what = agent.map_or("map".to_owned(), |agent| format!("share-{agent}"));
        let stem = if component == 0 { what } else { format!("{what}-{component}") };
        Files { folder: run.join("refined"), stem }
    }

    /// Refined surfels.
    pub fn map(&self) -> PathBuf {
        self.folder.join(format!("{}.ply", self.stem))
    }

    /// [`RefinedFacts`].
    pub fn facts(&self) -> PathBuf {
        self.folder.join(format!("{}.json", self.stem))
    }

    /// The state of a job that is not done.
    pub fn checkpoint(&self) -> PathBuf {
        self.folder.join(format!("{}.checkpoint", self.stem))
    }

    /// Writes what is left of a job that is done.
    pub fn write(&self, surfels: &SurfelCloud, facts: &RefinedFacts) -> anyhow::Result<()> {
        write_in_pieces(&self.map(), |out| Ok(coma_surfel::ply::write(surfels, out)?))?;
        write_atomically(&self.facts(), &serde_json::to_vec_pretty(facts)?)
    }

    fn read(&self, run: &Facts, component: usize) -> anyhow::Result<Option<(SurfelCloud, RefinedFacts)>> {
        let path = self.facts();
        if !path.exists() {
            return Ok(None);
        }
        let facts: RefinedFacts =
            serde_json::from_slice(&read_bounded(&path)?).with_context(|| path.display().to_string())?;
        let of = &run.components[component];
        if (&facts.component, &facts.digest, facts.base_surfels) != (&of.name, &of.digest, of.surfels) {
            bail!(
                "{}: was refined from another map than the run's; remove it, or refine again",
                path.display()
            );
        }
        Ok(Some((read_map(&self.map())?, facts)))
    }
}

/// A refined map of one component.
pub struct Refined {
    /// All its surfels.
    pub map: SurfelCloud,
    /// How it is rendered.
    pub render: RenderSettings,
    /// By agent's name and frame.
    pub poses: BTreeMap<(String, usize), Pose>,
}

/// The refined map of a component: the whole one, or what agents refined each for itself, and the run's own surfels
/// for the other agents. `None` where nothing was refined.
pub fn read(run: &Path, facts: &Facts, component: usize) -> anyhow::Result<Option<Refined>> {
    let by_frame =
        |facts: RefinedFacts| facts.poses.into_iter().map(|p| ((p.agent, p.frame), p.map_from_camera));
    if let Some((map, refined)) = Files::new(run, component, None).read(facts, component)? {
        let render = refined.settings.render();
        return Ok(Some(Refined { map, render, poses: by_frame(refined).collect() }));
    }
    let mut shares = BTreeMap::new();
    for agent in &facts.agents {
        if let Some(share) = Files::new(run, component, Some(&agent.name)).read(facts, component)? {
            shares.insert(agent.name.clone(), share);
        }
    }
    if shares.is_empty() {
        return Ok(None);
    }
    let base = read_map(&run.join(&facts.components[component].map))?;
    let render = shares.values().next().map(|(_, refined)| refined.settings.render()).unwrap_or_default();
    let mut out = Refined { map: SurfelCloud::default(), render, poses: BTreeMap::new() };
    for (agent, range) in owners(facts, component, &base)? {
        match shares.remove(&agent) {
            Some((share, refined)) => {
                share.iter().for_each(|s| out.map.push(s));
                out.poses.extend(by_frame(refined));
            }
            None => range.for_each(|i| out.map.push(base.get(i))),
        }
    }
    Ok(Some(out))
}

/// Whose surfels a component's map holds, agent by agent in the order of the map.
pub fn owners(
    facts: &Facts,
    component: usize,
    map: &SurfelCloud,
) -> anyhow::Result<Vec<(String, Range<usize>)>> {
    let mut submaps: Vec<&SubmapFacts> =
        facts.agents.iter().flat_map(|a| &a.submaps).filter(|s| s.component == Some(component)).collect();
    submaps.sort_by(|a, b| a.id.cmp(&b.id));
    let mut out: Vec<(String, Range<usize>)> = Vec::new();
    let mut end = 0;
    for submap in submaps {
        let count =
            submap.merged_surfels.context("run.json does not say whose surfels are whose: run anew")?;
        let agent = submap.id.agent.to_string();
        match out.last_mut().filter(|(last, _)| *last == agent) {
            Some((_, range)) => range.end += count,
            None => out.push((agent, end..end + count)),
        }
        end += count;
    }
    if end != map.len() {
        bail!("run.json speaks of {end} surfels, its map has {}", map.len());
    }
    Ok(out)
}

/// Reads a PLY file.
pub fn read_map(path: &Path) -> anyhow::Result<SurfelCloud> {
    let shown = || path.display().to_string();
    let file = BufReader::new(File::open(path).with_context(shown)?);
    coma_surfel::ply::read(file, MAX_SURFELS).with_context(shown)
}

/// Reads a file that is not absurdly long.
pub fn read_bounded(path: &Path) -> anyhow::Result<Vec<u8>> {
    let shown = || path.display().to_string();
    let bytes = std::fs::metadata(path).with_context(shown)?.len();
    if bytes > MAX_FILE_BYTES {
        bail!("{}: {bytes} bytes, at most {MAX_FILE_BYTES} are read", shown());
    }
    std::fs::read(path).with_context(shown)
}

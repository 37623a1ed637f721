//! `coma inspect loops`: every candidate of a run, what became of it and why.

mod overlay;

use crate::eval::Read;
use crate::progress;
use crate::run::facts::{End, LoopFacts};
use crate::source::Source;
use anyhow::Context;
use clap::{Args, ValueEnum};
use coma_frame::RgbdFrame;
use coma_geometry::{Pose, se3};
use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};

/// Lists every pair of places that was tried as a loop: verdict, reason and numbers; and shows them as pictures.
///
/// A picture has what both cameras saw on top, and below both clouds (orange: the first place, blue: the second, grey:
/// where they agree) from the first camera and from above. An accepted pair lies as its loop says, any other as the
/// solved map says; where neither knows, the clouds are left out.
#[derive(Args)]
pub struct Arguments {
    /// Folder of the run, as `coma run --out` wrote it. The sequences must lie where they lay during the run.
    dir: PathBuf,
    /// Lists only these.
    #[arg(long)]
    verdict: Option<Verdict>,
    /// Lists only candidates between two agents.
    #[arg(long)]
    between: bool,
    /// Writes a picture of each listed candidate to this folder.
    #[arg(long, value_name = "DIR")]
    pictures: Option<PathBuf>,
}

/// How candidates end.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Verdict {
    Accepted,
    Rejected,
    Withdrawn,
}

impl Verdict {
    fn as_str(self) -> &'static str {
        match self {
            Verdict::Accepted => "accepted",
            Verdict::Rejected => "rejected",
            Verdict::Withdrawn => "withdrawn",
        }
    }
}

/// Runs it.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let read = Read::open(&arguments.dir)?;
    let listed: Vec<(usize, &LoopFacts)> = read
        .loops
        .iter()
        .enumerate()
        .filter(|(_, l)| arguments.verdict.is_none_or(|v| l.verdict == v.as_str()))
        .filter(|(_, l)| !arguments.between || l.from.submap.agent != l.to.submap.agent)
        .collect();
    print!("{}", table(&read, &listed));
    print!("{}", counts(&listed));
    if let Some(folder) = &arguments.pictures {
        std::fs::create_dir_all(folder).with_context(|| folder.display().to_string())?;
        let bar = progress::steps("pictures", listed.len() as u64);
        let mut written = 0;
        for (number, line) in &listed {
            written += picture(&read, *number, line, folder)? as usize;
            bar.inc(1);
        }
        bar.finish_and_clear();
        println!("{written} pictures: {}", folder.display());
    }
    Ok(())
}

/// One line for each candidate. The error is that of an accepted motion against the truth, where that is known.
fn table(read: &Read, listed: &[(usize, &LoopFacts)]) -> String {
    let mut out = String::from(
        "| # | first place | frame | second place | frame | similarity | space | verdict | why | numbers | true error | weight |\n\
         |---|---|---|---|---|---|---|---|---|---|---|---|\n",
    );
    for (number, l) in listed {
        let frame = |end: &End| end.frame.map_or("-".to_owned(), |f| f.to_string());
        let numbers: Vec<String> =
            l.numbers.iter().map(|(name, value)| format!("{name} {}", short(*value))).collect();
        let why = l.message.as_deref().or(l.reason.as_deref()).or(l.solver.as_deref()).unwrap_or("");
        let error = true_error(read, l)
            .map_or(String::new(), |(m, rad)| format!("{:.1} cm, {:.2} deg", m * 100.0, rad.to_degrees()));
        let weight = l.weight.map_or(String::new(), |w| format!("{w:.2}"));
        let space: String = l.space.chars().take(16).collect();
        let _ = writeln!(
            out,
            "| {number} | {} | {} | {} | {} | {:.3} | {space} | {} | {why} | {} | {error} | {weight} |",
            l.from.submap,
            frame(&l.from),
            l.to.submap,
            frame(&l.to),
            l.similarity,
            l.verdict,
            numbers.join(", ")
        );
    }
    out
}

/// Whole numbers as they are, others with three digits that matter.
fn short(value: f64) -> String {
    if value == value.trunc() && value.abs() < 1e9 {
        return format!("{value}");
    }
    let digits = (2.0 - value.abs().log10().floor()).clamp(0.0, 6.0) as usize;
    format!("{value:.digits$}")
}

/// How many ended how.
fn counts(listed: &[(usize, &LoopFacts)]) -> String {
    let mut by_reason: BTreeMap<(&str, &str), usize> = BTreeMap::new();
    for (_, l) in listed {
        *by_reason.entry((&l.verdict, l.reason.as_deref().unwrap_or(""))).or_default() += 1;
    }
    let mut out = format!("\n{} candidates\n", listed.len());
    for ((verdict, reason), count) in by_reason {
        let _ = writeln!(out, "{count:6} {verdict} {reason}");
    }
    out
}

fn source<'a>(read: &'a Read, end: &End) -> Option<(usize, &'a Source)> {
    let agent = read.facts.agents.iter().position(|a| a.name == end.submap.agent.as_str())?;
    Some((agent, &read.sources[agent]))
}

/// Metres and radians between an accepted motion and the true one.
fn true_error(read: &Read, l: &LoopFacts) -> Option<(f64, f64)> {
    let truth = |end: &End| source(read, end)?.1.sequence.truth(end.frame?);
    let measured = l.edge.as_ref()?.from_from_to;
    Some(se3::distance(&truth(&l.from)?.inv_mul(&truth(&l.to)?), &measured))
}

/// The motion from the second place to the first: the loop's own, or the solved map's.
fn motion(read: &Read, l: &LoopFacts) -> Option<Pose> {
    if let Some(edge) = &l.edge {
        return Some(edge.from_from_to);
    }
    let solved = |end: &End| {
        let (agent, _) = source(read, end)?;
        let mut tracks = read.tracks.iter().filter(move |((a, _), _)| *a == agent);
        tracks.find_map(|((_, component), poses)| {
            let found = poses.iter().find(|(frame, _)| Some(*frame) == end.frame)?;
            Some((*component, found.1))
        })
    };
    let (from, to) = (solved(&l.from)?, solved(&l.to)?);
    (from.0 == to.0).then(|| from.1.inv_mul(&to.1))
}

/// Writes a candidate's picture; false if one of its anchors is no frame of a sequence.
fn picture(read: &Read, number: usize, l: &LoopFacts, folder: &Path) -> anyhow::Result<bool> {
    let frame = |end: &End| -> anyhow::Result<Option<RgbdFrame>> {
        let Some(((_, source), index)) = source(read, end).zip(end.frame) else { return Ok(None) };
        Ok(Some(coma_dataset::sequence::rgbd_frame(&*source.sequence, index)?))
    };
    let (Some(from), Some(to)) = (frame(&l.from)?, frame(&l.to)?) else { return Ok(false) };
    let sheet = overlay::sheet(&from, &to, motion(read, l).as_ref());
    let name = |end: &End| format!("{}-{}", end.submap.agent, end.submap.number);
    let file = format!("{number:04}-{}-{}-{}.png", l.verdict, name(&l.from), name(&l.to));
    let path = folder.join(file);
    sheet.save(&path).with_context(|| path.display().to_string())?;
    Ok(true)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_keep_three_digits_that_matter() {
        assert_eq!(short(12.0), "12");
        assert_eq!(short(0.012345), "0.0123");
        assert_eq!(short(0.8374), "0.837");
        assert_eq!(short(123.456), "123");
        assert_eq!(short(1.5e-9), "0.000000");
        assert_eq!(short(f64::NAN), "NaN");
    }
}

//! g2o files with 3D poses: `VERTEX_SE3:QUAT id x y z qx qy qz qw` and
//! `EDGE_SE3:QUAT from to x y z qx qy qz qw` followed by the upper triangle of the information matrix.
//!
//! The information is in the order x y z qx qy qz, taken as that of (translation, rotation vector), as
//! GTSAM takes it, without a factor of 4. `FIX id` holds a vertex; `#` starts a comment.

use crate::graph::{Edge, GraphEntries, UsableGraph};
use crate::solution::Solution;
use crate::solver::{Constraint, Problem};
use coma_geometry::{Matrix6, Pose, SubmapId};
use nalgebra::{Quaternion, Translation3, UnitQuaternion};
use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write;

/// A graph as a file holds it.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct G2oGraph {
    /// `map_from_vertex` by id.
    pub vertices: BTreeMap<u64, Pose>,
    /// In the order of the file.
    pub edges: Vec<G2oEdge>,
    /// Vertices that stay where they are.
    pub fixed: BTreeSet<u64>,
}

/// A measurement.
#[derive(Clone, Debug, PartialEq)]
pub struct G2oEdge {
    /// Vertex i.
    pub from: u64,
    /// Vertex j.
    pub to: u64,
    /// Measured `i_from_j`.
    pub from_from_to: Pose,
    /// Information, order (translation, rotation).
    pub information: Matrix6,
}

/// What a file may hold.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct G2oLimits {
    /// Most vertices.
    pub vertices: usize,
    /// Most edges.
    pub edges: usize,
    /// Longest line, bytes.
    pub line_bytes: usize,
}

impl Default for G2oLimits {
    fn default() -> Self {
        G2oLimits { vertices: 1_000_000, edges: 10_000_000, line_bytes: 4096 }
    }
}

/// Why a text is no g2o graph; lines count from 1.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum G2oError {
    /// A line holds too few fields.
    #[error("line {line}: {tag} has {found} fields, {needed} needed")]
    Fields {
        /// Line number.
        line: usize,
        /// The line's first word.
        tag: String,
        /// Fields after the first word.
        found: usize,
        /// Fields that the tag needs.
        needed: usize,
    },
    /// A field that is no number, or not one that is allowed.
    #[error("line {line}: field {field} is {text:?}, {needed}")]
    Number {
        /// Line number.
        line: usize,
        /// Which field, by its name in the format.
        field: &'static str,
        /// Its text, cut to 40 characters.
        text: String,
        /// What would have been accepted.
        needed: &'static str,
    },
    /// A tag that is not known.
    #[error("line {line}: tag {tag:?} is not known: VERTEX_SE3:QUAT, EDGE_SE3:QUAT and FIX are")]
    Tag {
        /// Line number.
        line: usize,
        /// The tag, cut to 40 characters.
        tag: String,
    },
    /// A vertex that was given twice.
    #[error("line {line}: vertex {id} was given before")]
    Duplicate {
        /// Line number.
        line: usize,
        /// The vertex.
        id: u64,
    },
    /// An edge whose vertex is missing.
    #[error("edge {edge} (from 0) names vertex {id}, which is not in the file")]
    UnknownVertex {
        /// Index of the edge.
        edge: usize,
        /// The vertex.
        id: u64,
    },
    /// More than the limits allow.
    #[error("line {line}: more than {limit} {what}")]
    TooLarge {
        /// Line number.
        line: usize,
        /// Vertices, edges or bytes in a line.
        what: &'static str,
        /// The limit.
        limit: usize,
    },
}

const POSE_FIELDS: [&str; 7] = ["x", "y", "z", "qx", "qy", "qz", "qw"];

struct Line<'a> {
    number: usize,
    tag: &'a str,
    fields: Vec<&'a str>,
}

fn cut(text: &str) -> String {
    text.chars().take(40).collect()
}

impl Line<'_> {
    fn need(&self, needed: usize) -> Result<(), G2oError> {
        if self.fields.len() == needed {
            return Ok(());
        }
        Err(G2oError::Fields { line: self.number, tag: cut(self.tag), found: self.fields.len(), needed })
    }

    fn id(&self, index: usize, field: &'static str) -> Result<u64, G2oError> {
        let text = self.fields[index];
        text.parse().map_err(|_| G2oError::Number {
            line: self.number,
            field,
            text: cut(text),
            needed: "a whole number from 0 to 2^64 - 1 is needed",
        })
    }

    fn float(&self, index: usize, field: &'static str) -> Result<f64, G2oError> {
        let text = self.fields[index];
        text.parse::<f64>().ok().filter(|v| v.is_finite() && v.abs() < 1e15).ok_or_else(|| G2oError::Number {
            line: self.number,
            field,
            text: cut(text),
            needed: "a finite number below 1e15 is needed",
        })
    }

    fn pose(&self, first: usize) -> Result<Pose, G2oError> {
        let mut v = [0.0; 7];
        for (k, value) in v.iter_mut().enumerate() {
            *value = self.float(first + k, POSE_FIELDS[k])?;
        }
        let quaternion = Quaternion::new(v[6], v[3], v[4], v[5]);
        // Files print 6 digits; more than a tenth off is no rounding.
        if !((quaternion.norm() - 1.0).abs() < 0.1) {
            return Err(G2oError::Number {
                line: self.number,
                field: "qx qy qz qw",
                text: cut(&format!("{quaternion}")),
                needed: "a quaternion of length 1 is needed",
            });
        }
        Ok(Pose::from_parts(Translation3::new(v[0], v[1], v[2]), UnitQuaternion::from_quaternion(quaternion)))
    }
}

impl G2oGraph {
    /// Reads a text within the default limits.
    pub fn parse(text: &str) -> Result<Self, G2oError> {
        Self::parse_within(text, &G2oLimits::default())
    }

    /// Reads a text. Never panics; allocates no more than the limits and the text's own size imply.
    pub fn parse_within(text: &str, limits: &G2oLimits) -> Result<Self, G2oError> {
        let graph = Self::parse_part(text, limits)?;
        graph.check()?;
        Ok(graph)
    }

    /// Reads one of several texts that are one graph together: edges may name vertices that are in another.
    pub fn parse_part(text: &str, limits: &G2oLimits) -> Result<Self, G2oError> {
        let mut graph = G2oGraph::default();
        for (index, full) in text.lines().enumerate() {
            let number = index + 1;
            if full.len() > limits.line_bytes {
                return Err(G2oError::TooLarge {
                    line: number,
                    what: "bytes in a line",
                    limit: limits.line_bytes,
                });
            }
            let mut words = full.split('#').next().unwrap_or("").split_whitespace();
            let Some(tag) = words.next() else { continue };
            let line = Line { number, tag, fields: words.collect() };
            match tag {
                "VERTEX_SE3:QUAT" => graph.read_vertex(&line, limits)?,
                "EDGE_SE3:QUAT" => graph.read_edge(&line, limits)?,
                "FIX" => {
                    for k in 0..line.fields.len() {
                        graph.fixed.insert(line.id(k, "id")?);
                    }
                }
                _ => return Err(G2oError::Tag { line: number, tag: cut(tag) }),
            }
        }
        Ok(graph)
    }

    /// Refuses edges whose vertices are missing.
    pub fn check(&self) -> Result<(), G2oError> {
        for (edge, e) in self.edges.iter().enumerate() {
            if let Some(id) = [e.from, e.to].into_iter().find(|id| !self.vertices.contains_key(id)) {
                return Err(G2oError::UnknownVertex { edge, id });
            }
        }
        Ok(())
    }

    fn read_vertex(&mut self, line: &Line, limits: &G2oLimits) -> Result<(), G2oError> {
        line.need(8)?;
        let id = line.id(0, "id")?;
        if self.vertices.len() >= limits.vertices {
            return Err(G2oError::TooLarge { line: line.number, what: "vertices", limit: limits.vertices });
        }
        if self.vertices.insert(id, line.pose(1)?).is_some() {
            return Err(G2oError::Duplicate { line: line.number, id });
        }
        Ok(())
    }

    fn read_edge(&mut self, line: &Line, limits: &G2oLimits) -> Result<(), G2oError> {
        line.need(30)?;
        if self.edges.len() >= limits.edges {
            return Err(G2oError::TooLarge { line: line.number, what: "edges", limit: limits.edges });
        }
        let mut information = Matrix6::zeros();
        let mut field = 9;
        for row in 0..6 {
            for column in row..6 {
                let value = line.float(field, "information")?;
                information[(row, column)] = value;
                information[(column, row)] = value;
                field += 1;
            }
        }
        let (from, to) = (line.id(0, "from")?, line.id(1, "to")?);
        if from == to {
            return Err(G2oError::Number {
                line: line.number,
                field: "to",
                text: to.to_string(),
                needed: "another vertex than `from` is needed",
            });
        }
        self.edges.push(G2oEdge { from, to, from_from_to: line.pose(2)?, information });
        Ok(())
    }

    /// The file's text; numbers are written so that they read back exactly.
    pub fn to_text(&self) -> String {
        let mut out = String::new();
        // Writing to a string cannot fail.
        for (id, pose) in &self.vertices {
            let _ = write!(out, "VERTEX_SE3:QUAT {id}");
            write_pose(&mut out, pose);
            out.push('\n');
        }
        for id in &self.fixed {
            let _ = writeln!(out, "FIX {id}");
        }
        for e in &self.edges {
            let _ = write!(out, "EDGE_SE3:QUAT {} {}", e.from, e.to);
            write_pose(&mut out, &e.from_from_to);
            for row in 0..6 {
                for column in row..6 {
                    let _ = write!(out, " {}", e.information[(row, column)]);
                }
            }
            out.push('\n');
        }
        out
    }

    /// A solved graph: every submap of every component, odometry, and the loops that were used; gauges are fixed.
    /// Vertex `k` is the `k`-th of the submaps returned beside it.
    pub fn from_solution(solution: &Solution, entries: &GraphEntries) -> (Self, Vec<SubmapId>) {
        let mut graph = G2oGraph::default();
        let mut submaps = Vec::new();
        let mut vertex: BTreeMap<&SubmapId, u64> = BTreeMap::new();
        for component in &solution.components {
            for (submap, pose) in &component.map_from_submap {
                let id = submaps.len() as u64;
                vertex.insert(submap, id);
                graph.vertices.insert(id, *pose);
                if *submap == component.gauge {
                    graph.fixed.insert(id);
                }
                submaps.push(submap.clone());
            }
        }
        let loops = solution.components.iter().flat_map(|c| &c.loops);
        let used: BTreeSet<_> = loops.filter(|l| l.weight >= 0.5).map(|l| &l.key).collect();
        let usable = UsableGraph::new(entries);
        let kept = |e: &&Edge| used.contains(&e.key);
        for e in usable.odometry.iter().chain(usable.loops.iter().filter(kept)) {
            if let (Some(&from), Some(&to)) = (vertex.get(&e.from), vertex.get(&e.to)) {
                let (from_from_to, information) = (e.from_from_to, e.information);
                graph.edges.push(G2oEdge { from, to, from_from_to, information });
            }
        }
        (graph, submaps)
    }

    /// The problem over vertices in ascending order of id, with the file's poses as the start. Without `FIX`
    /// the smallest id is held.
    pub fn problem(&self) -> (Problem, Vec<Pose>) {
        let index: BTreeMap<u64, usize> = self.vertices.keys().enumerate().map(|(k, id)| (*id, k)).collect();
        let constraints = self
            .edges
            .iter()
            .filter_map(|e| {
                Some(Constraint {
                    from: *index.get(&e.from)?,
                    to: *index.get(&e.to)?,
                    from_from_to: e.from_from_to,
                    information: e.information,
                })
            })
            .collect();
        let mut fixed: Vec<bool> = self.vertices.keys().map(|id| self.fixed.contains(id)).collect();
        if !fixed.contains(&true) && !fixed.is_empty() {
            fixed[0] = true;
        }
        let problem = Problem { nodes: self.vertices.len(), constraints, fixed };
        (problem, self.vertices.values().copied().collect())
    }
}

fn write_pose(out: &mut String, pose: &Pose) {
    let t = pose.translation.vector;
    let q = pose.rotation.coords;
    for value in [t.x, t.y, t.z, q.x, q.y, q.z, q.w] {
        let _ = write!(out, " {value}");
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SMALL: &str = "# two poses\nVERTEX_SE3:QUAT 0 0 0 0 0 0 0 1\nVERTEX_SE3:QUAT 18446744073709551615 1.5 -2 0.25 0.5 0.5 0.5 0.5\n\
        FIX 0\nEDGE_SE3:QUAT 0 18446744073709551615 1 2 3 0 0 0.6 0.8 1 .1 0 0 0 0 2 0 0 0 0 3 0 0 0 4 0 0 5 .2 6\n";

    #[test]
    fn writing_and_reading_gives_the_same_graph() {
        let graph = G2oGraph::parse(SMALL).unwrap();
        assert_eq!(graph.vertices.len(), 2);
        assert_eq!(graph.edges[0].information[(0, 1)], 0.1);
        assert_eq!(graph.edges[0].information[(5, 4)], 0.2);
        let text = graph.to_text();
        let again = G2oGraph::parse(&text).unwrap();
        assert_eq!(again.to_text(), text);
        for (a, b) in graph.vertices.values().zip(again.vertices.values()) {
            assert!((a.to_homogeneous() - b.to_homogeneous()).norm() < 1e-15);
        }
    }

    #[test]
    fn errors_name_the_line_and_the_field() {
        let bad = |text: &str| G2oGraph::parse(text).unwrap_err().to_string();
        assert_eq!(bad("VERTEX_SE3:QUAT 0 0 0"), "line 1: VERTEX_SE3:QUAT has 3 fields, 8 needed");
        assert!(bad("\nVERTEX_SE3:QUAT 0 0 nan 0 0 0 0 1").contains("line 2: field y is \"nan\""));
        assert!(bad("VERTEX_SE3:QUAT 0 0 0 0 0 0 0 0").contains("length 1"));
        assert!(bad("VERTEX_SE2 0 0 0 0").contains("line 1: tag \"VERTEX_SE2\""));
        assert!(bad(&SMALL.replace("VERTEX_SE3:QUAT 0 ", "VERTEX_SE3:QUAT 7 ")).contains("vertex 0"));
    }

    #[test]
    fn limits_hold() {
        let limits = G2oLimits { vertices: 1, ..G2oLimits::default() };
        let error = G2oGraph::parse_within(SMALL, &limits).unwrap_err();
        assert_eq!(error, G2oError::TooLarge { line: 3, what: "vertices", limit: 1 });
    }

    #[test]
    fn damaged_text_never_panics() {
        let mut state = 7u64;
        let mut random = move |below: usize| {
            state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
            (state >> 33) as usize % below
        };
        let alphabet: Vec<char> = "0123456789.-+eE #\n\t:VERTEXDGFINSQUAinfä\u{0}".chars().collect();
        for _ in 0..3000 {
            let mut text: Vec<char> = SMALL.chars().collect();
            for _ in 0..1 + random(8) {
                let at = random(text.len().max(1));
                if text.len() < 2 {
                    break;
                }
                match random(3) {
                    0 => text[at] = alphabet[random(alphabet.len())],
                    1 => {
                        text.remove(at);
                    }
                    _ => text.truncate(at.max(1)),
                }
            }
            let text: String = text.into_iter().collect();
            if let Ok(graph) = G2oGraph::parse(&text) {
                let (problem, start) = graph.problem();
                let weights = vec![1.0; problem.constraints.len()];
                let _ = problem.solve(&start, &weights, &crate::SolverSettings::default());
            }
        }
    }
}

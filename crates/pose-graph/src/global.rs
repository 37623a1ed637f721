//! Global phase (eq. 10): the canonical solve of a cut.

use crate::chain::{Chain, Trunk, chains, extend_by_composition};
use crate::consistency::{Bridge, lonely};
use crate::gnc::{self, RobustSettings, RobustSolved, Trust};
use crate::graph::{DEFAULT_ANCHOR_PRIORITY, Edge, EdgeKey, GraphEntries, NodeInfo, UsableGraph};
use crate::relative::{JoinSettings, Joined, NotJoined, join};
use crate::sets::Sets;
use crate::solution::{Component, LoopVerdict, LoopWeight, PairJoin, PairReport, Solution, pose_digest};
use crate::solver::{Constraint, Problem, SolveError, SolverSettings};
use coma_geometry::{AgentId, MapId, Pose, SubmapId};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet};

/// Everything that shapes a result besides the entries. Agents that are to agree must have equal ones.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct GlobalSettings {
    /// Iterations and damping.
    pub solver: SolverSettings,
    /// Which loops are believed.
    pub robust: RobustSettings,
    /// What two chains need to join.
    pub join: JoinSettings,
}

/// Solves everything that the entries hold: cold and in sorted order, so that equal sets of entries and settings give
/// equal bits, whatever the number of threads.
///
/// Chains with enough consistent loops join (see [`join`]); each component starts from its chains laid out over
/// a spanning tree of the T_st, and is solved over odometry and all its loops with robust weights. The gauge is
/// the first submap of the agent with the smallest (anchor priority, id). Odometry beyond the cut is composed.
pub fn solve(entries: &GraphEntries, settings: &GlobalSettings) -> Solution {
    let graph = UsableGraph::new(entries);
    let chains = chains(&graph);
    let chain_of = chain_of(&chains);
    let pairs = chain_pairs(&graph.loops, &chain_of);
    let trunks = lay_out(&chains, &graph.loops, &chain_of, &pairs, settings);
    // Pairs know nothing of each other: which thread takes which does not matter.
    let joins: Joins = pairs
        .par_iter()
        .map(|(&(s, t), between)| {
            let outcome = relate(between, &trunks[s], &trunks[t], &graph.nodes, settings);
            ((s, t), outcome)
        })
        .collect();
    let mut components: Vec<Component> = connected_chains(chains.len(), &joins)
        .iter()
        .map(|members| {
            solve_component(members, &chains, &chain_of, &trunks, &graph, &joins, &pairs, entries, settings)
        })
        .collect();
    components.sort_by(|a, b| a.map_id.cmp(&b.map_id));
    let mut hasher = blake3::Hasher::new();
    for component in &components {
        hasher.update(&component.digest);
    }
    Solution {
        waiting: waiting(&pairs, &joins, &components),
        pairs: reports(&pairs, &joins, &chains, &graph.nodes),
        components,
        rejected: graph.rejected,
        cut: graph.cut,
        digest: *hasher.finalize().as_bytes(),
    }
}

/// The loops between two chains, by key, each with whether it starts in the first of them.
pub(crate) type Between<'a> = Vec<(&'a Edge, bool)>;
pub(crate) type Joins = BTreeMap<(usize, usize), Result<Joined, NotJoined>>;

/// The chain that holds each submap.
pub(crate) type ChainOf<'a> = BTreeMap<&'a SubmapId, usize>;

pub(crate) fn chain_of(chains: &[Chain]) -> ChainOf<'_> {
    let mut out = ChainOf::new();
    for (index, chain) in chains.iter().enumerate() {
        out.extend(chain.submaps.iter().map(|s| (s, index)));
    }
    out
}

/// The chain that holds both ends of a loop.
pub(crate) fn chain_within(chain_of: &ChainOf, edge: &Edge) -> Option<usize> {
    let (from, to) = (chain_of.get(&edge.from)?, chain_of.get(&edge.to)?);
    (from == to).then_some(*from)
}

pub(crate) fn chain_pairs<'a>(
    loops: &'a [Edge],
    chain_of: &ChainOf,
) -> BTreeMap<(usize, usize), Between<'a>> {
    let mut pairs: BTreeMap<(usize, usize), Between> = BTreeMap::new();
    for edge in loops {
        if let (Some(&a), Some(&b)) = (chain_of.get(&edge.from), chain_of.get(&edge.to))
            && a != b
        {
            pairs.entry((a.min(b), a.max(b))).or_default().push((edge, a < b));
        }
    }
    pairs
}

/// Lays every chain out by its odometry, and those that may join another one by their own loops too.
pub(crate) fn lay_out(
    chains: &[Chain],
    loops: &[Edge],
    chain_of: &ChainOf,
    pairs: &BTreeMap<(usize, usize), Between>,
    settings: &GlobalSettings,
) -> Vec<Trunk> {
    let mut own_loops: Vec<Vec<&Edge>> = vec![Vec::new(); chains.len()];
    for edge in loops {
        if let Some(chain) = chain_within(chain_of, edge) {
            own_loops[chain].push(edge);
        }
    }
    let paired: BTreeSet<usize> = pairs.keys().flat_map(|(s, t)| [*s, *t]).collect();
    let lay_out_one = |(index, chain): (usize, &Chain)| {
        let mut trunk = Trunk::new(chain);
        let own = &own_loops[index];
        let limit = settings.robust.squared_error_6dof;
        let apart: Vec<bool> = lonely(own, &trunk, limit);
        trunk.lonely.extend(own.iter().zip(&apart).filter(|(_, l)| **l).map(|(e, _)| e.key.clone()));
        if paired.contains(&index) && !own.is_empty() {
            let trust: Vec<Trust> =
                apart.iter().map(|l| if *l { Trust::Suspended } else { Trust::Doubted }).collect();
            let robust = Indexed::new(&trunk.chain_from_submap, &chain.first).solve(
                chain.solved_odometry.iter(),
                own,
                &trust,
                settings,
            );
            if let (submaps, Ok(robust)) = robust {
                trunk.chain_from_submap = submaps.into_iter().zip(robust.solved.poses).collect();
            }
        }
        trunk
    };
    chains.par_iter().enumerate().map(lay_out_one).collect()
}

pub(crate) fn relate(
    between: &Between,
    s: &Trunk,
    t: &Trunk,
    nodes: &BTreeMap<SubmapId, NodeInfo>,
    settings: &GlobalSettings,
) -> Result<Joined, NotJoined> {
    let bridges: Vec<Option<Bridge>> =
        between.iter().map(|(edge, forward)| Bridge::new(edge, *forward)).collect();
    let sound: Vec<Bridge> = bridges.iter().flatten().cloned().collect();
    let joined = join(&sound, s, t, nodes, &settings.join, &settings.robust)?;
    let mut fits = joined.consistent.iter();
    // A loop whose information has no inverse cannot be tested, and does not count.
    let consistent = bridges.iter().map(|b| b.is_some() && *fits.next().unwrap_or(&false)).collect();
    Ok(Joined { consistent, ..joined })
}

/// Chains that joins connect, directly or through others.
fn connected_chains(count: usize, joins: &Joins) -> Vec<Vec<usize>> {
    let mut connected = Sets::new(count);
    for ((s, t), _) in joins.iter().filter(|(_, outcome)| outcome.is_ok()) {
        connected.join(*s, *t);
    }
    let mut groups: BTreeMap<usize, Vec<usize>> = BTreeMap::new();
    for k in 0..count {
        groups.entry(connected.find(k)).or_default().push(k);
    }
    groups.into_values().collect()
}

/// The first submap of the agent with the smallest (anchor priority, id), alive or not.
fn gauge(members: &[usize], chains: &[Chain], priority: &BTreeMap<AgentId, u32>) -> SubmapId {
    let firsts = members.iter().map(|&k| &chains[k].first);
    let of = |agent: &AgentId| priority.get(agent).copied().unwrap_or(DEFAULT_ANCHOR_PRIORITY);
    let chosen = firsts.min_by_key(|first| (of(&first.agent), *first));
    chosen.map_or_else(|| chains[members[0]].first.clone(), SubmapId::clone)
}

/// `root_from_chain` of every member: from `root` over the joins with the most consistent loops first (Prim).
fn place_chains(root: usize, members: &[usize], joins: &Joins) -> BTreeMap<usize, Pose> {
    let mut placed = BTreeMap::from([(root, Pose::identity())]);
    while placed.len() < members.len() {
        let next = joins
            .iter()
            .filter_map(|(pair, outcome)| Some((pair, outcome.as_ref().ok()?)))
            .filter(|((s, t), _)| placed.contains_key(s) != placed.contains_key(t))
            .min_by_key(|(pair, joined)| (Reverse(joined.consistent.iter().filter(|c| **c).count()), *pair));
        let Some(((s, t), joined)) = next else { break };
        match (placed.get(s), placed.get(t)) {
            (Some(root_from_s), _) => placed.insert(*t, root_from_s * joined.s_from_t),
            (_, Some(root_from_t)) => placed.insert(*s, root_from_t * joined.s_from_t.inverse()),
            _ => break,
        };
    }
    placed
}

/// Submaps with a start, by index; the indices ascend with the ids.
struct Indexed<'a> {
    start: &'a BTreeMap<SubmapId, Pose>,
    fixed: &'a SubmapId,
}

impl<'a> Indexed<'a> {
    fn new(start: &'a BTreeMap<SubmapId, Pose>, fixed: &'a SubmapId) -> Self {
        Indexed { start, fixed }
    }

    /// Solves over odometry and loops; `trust` is one per loop. Gives the submaps in the order of the poses; the weights
    /// are those of the loops.
    fn solve<'e>(
        &self,
        odometry: impl Iterator<Item = &'e Edge>,
        loops: &[&Edge],
        trust: &[Trust],
        settings: &GlobalSettings,
    ) -> (Vec<SubmapId>, Result<RobustSolved, SolveError>) {
        let submaps: Vec<SubmapId> = self.start.keys().cloned().collect();
        let index: BTreeMap<&SubmapId, usize> = submaps.iter().enumerate().map(|(k, s)| (s, k)).collect();
        let constraint = |edge: &Edge| {
            Some(Constraint {
                from: *index.get(&edge.from)?,
                to: *index.get(&edge.to)?,
                from_from_to: edge.from_from_to,
                information: edge.information,
            })
        };
        let mut constraints: Vec<Constraint> = odometry.filter_map(constraint).collect();
        let trusted = constraints.len();
        constraints.extend(loops.iter().filter_map(|e| constraint(e)));
        let mut all_trust = vec![Trust::Full; trusted];
        all_trust.extend_from_slice(trust);
        let fixed = submaps.iter().map(|s| s == self.fixed).collect();
        let problem = Problem { nodes: submaps.len(), constraints, fixed };
        let start: Vec<Pose> = self.start.values().copied().collect();
        let outcome = if all_trust.len() == problem.constraints.len() {
            gnc::solve(&problem, &start, &all_trust, &settings.robust, &settings.solver)
        } else {
            Err(SolveError::Size {
                what: "loops with both ends in the graph",
                found: problem.constraints.len() - trusted,
                needed: trust.len(),
            })
        };
        let outcome = outcome.map(|mut robust| {
            robust.weights.drain(..trusted);
            robust
        });
        (submaps, outcome)
    }
}

fn solve_component(
    members: &[usize],
    chains: &[Chain],
    chain_of: &ChainOf,
    trunks: &[Trunk],
    graph: &UsableGraph,
    joins: &Joins,
    pairs: &BTreeMap<(usize, usize), Between>,
    entries: &GraphEntries,
    settings: &GlobalSettings,
) -> Component {
    let gauge = gauge(members, chains, &entries.anchor_priority);
    let root = members.iter().copied().find(|&k| chains[k].first == gauge).unwrap_or(members[0]);
    let mut start = BTreeMap::new();
    for (chain, map_from_chain) in place_chains(root, members, joins) {
        let trunk = &trunks[chain].chain_from_submap;
        start.extend(trunk.iter().map(|(s, chain_from_s)| (s.clone(), map_from_chain * chain_from_s)));
    }
    let within = |e: &&Edge| start.contains_key(&e.from) && start.contains_key(&e.to);
    let loops: Vec<&Edge> = graph.loops.iter().filter(within).collect();
    let contradicting = contradicting(pairs, joins);
    // A loop that nothing supports is left out until the others say where its ends are.
    let supported = supported(pairs, joins);
    let believed = |e: &Edge| match chain_within(chain_of, e) {
        Some(k) => !trunks[k].lonely.contains(&e.key),
        None => supported.contains(&e.key),
    };
    let trust: Vec<Trust> =
        loops.iter().map(|e| if believed(e) { Trust::Doubted } else { Trust::Suspended }).collect();
    let odometry = members.iter().flat_map(|&k| chains[k].solved_odometry.iter());
    let (submaps, outcome) = Indexed::new(&start, &gauge).solve(odometry, &loops, &trust, settings);
    let weigh = |edge: &Edge, weight: f64, poses: &BTreeMap<SubmapId, Pose>| {
        let limit = settings.robust.limit(chain_within(chain_of, edge).is_some());
        weigh(edge, weight, poses, contradicting.contains(&edge.key), limit)
    };
    let mut component = Component {
        map_id: MapId::of(&gauge),
        agents: members.iter().map(|&k| chains[k].first.agent.clone()).collect(),
        map_from_submap: start.clone(),
        composed: BTreeSet::new(),
        cost: 0.0,
        initial_cost: 0.0,
        iterations: 0,
        converged: false,
        failure: None,
        loops: Vec::new(),
        digest: [0; 32],
        gauge,
    };
    match outcome {
        Ok(RobustSolved { solved, weights, .. }) => {
            component.map_from_submap = submaps.into_iter().zip(solved.poses).collect();
            component.loops = loops
                .iter()
                .zip(&weights)
                .map(|(edge, weight)| weigh(edge, *weight, &component.map_from_submap))
                .collect();
            component.cost = solved.cost;
            component.initial_cost = solved.initial_cost;
            component.iterations = solved.iterations;
            component.converged = solved.converged;
        }
        Err(error) => {
            component.failure = Some(error.to_string());
            let not_weighed = |edge: &&Edge| LoopWeight {
                verdict: LoopVerdict::NotWeighed,
                ..weigh(edge, 0.0, &component.map_from_submap)
            };
            component.loops = loops.iter().map(not_weighed).collect();
        }
    }
    component.digest = pose_digest(&component.map_id, &component.map_from_submap);
    for &k in members {
        component.composed.extend(extend_by_composition(&mut component.map_from_submap, &chains[k].odometry));
    }
    component
}

/// Loops in the consistent set of a pair of chains that joined.
pub(crate) fn supported(pairs: &BTreeMap<(usize, usize), Between>, joins: &Joins) -> BTreeSet<EdgeKey> {
    let mut out = BTreeSet::new();
    for (pair, between) in pairs {
        if let Some(Ok(joined)) = joins.get(pair) {
            let agreeing = between.iter().zip(&joined.consistent).filter(|(_, consistent)| **consistent);
            out.extend(agreeing.map(|((edge, _), _)| edge.key.clone()));
        }
    }
    out
}

/// Loops that do not belong to the consistent set of a pair of chains that joined.
pub(crate) fn contradicting(pairs: &BTreeMap<(usize, usize), Between>, joins: &Joins) -> BTreeSet<EdgeKey> {
    let mut out = BTreeSet::new();
    for (pair, between) in pairs {
        if let Some(Ok(joined)) = joins.get(pair) {
            let against = between.iter().zip(&joined.consistent).filter(|(_, consistent)| !**consistent);
            out.extend(against.map(|((edge, _), _)| edge.key.clone()));
        }
    }
    out
}

fn weigh(
    edge: &Edge,
    weight: f64,
    poses: &BTreeMap<SubmapId, Pose>,
    contradicts: bool,
    limit: f64,
) -> LoopWeight {
    let squared_error = match (poses.get(&edge.from), poses.get(&edge.to)) {
        (Some(i), Some(j)) => {
            let error = crate::residual::residual(i, j, &edge.from_from_to);
            crate::residual::squared_mahalanobis(&error, &edge.information)
        }
        _ => f64::NAN,
    };
    LoopWeight::judged(edge, weight, squared_error, contradicts, limit)
}

/// Loops whose ends ended up in different components.
fn waiting(
    pairs: &BTreeMap<(usize, usize), Between>,
    joins: &Joins,
    components: &[Component],
) -> Vec<LoopWeight> {
    let placed: BTreeSet<&EdgeKey> = components.iter().flat_map(|c| &c.loops).map(|l| &l.key).collect();
    let mut out = Vec::new();
    for (pair, between) in pairs {
        let Some(Err(reason)) = joins.get(pair) else { continue };
        for (edge, _) in between.iter().filter(|(edge, _)| !placed.contains(&edge.key)) {
            out.push(LoopWeight {
                key: edge.key.clone(),
                from: edge.from.clone(),
                to: edge.to.clone(),
                weight: 0.0,
                squared_error: f64::NAN,
                verdict: LoopVerdict::Waiting(reason.clone()),
            });
        }
    }
    out.sort_by(|a, b| a.key.cmp(&b.key));
    out
}

fn reports(
    pairs: &BTreeMap<(usize, usize), Between>,
    joins: &Joins,
    chains: &[Chain],
    nodes: &BTreeMap<SubmapId, NodeInfo>,
) -> Vec<PairReport> {
    let agent_from = |first: &SubmapId| nodes.get(first).map_or(Pose::identity(), |n| n.agent_from_submap);
    let report = |(pair, between): (&(usize, usize), &Between)| {
        let (s, t) = (&chains[pair.0].first, &chains[pair.1].first);
        let outcome = joins.get(pair)?.clone().map(|joined| PairJoin {
            agent_s_from_agent_t: agent_from(s) * joined.s_from_t * agent_from(t).inverse(),
            s_from_t: joined.s_from_t,
            consistent: between
                .iter()
                .zip(&joined.consistent)
                .filter(|(_, consistent)| **consistent)
                .map(|((edge, _), _)| edge.key.clone())
                .collect(),
            independent: joined.independent,
        });
        let loops = between.iter().map(|(edge, _)| edge.key.clone()).collect();
        Some(PairReport { s: s.clone(), t: t.clone(), loops, outcome })
    };
    pairs.iter().filter_map(report).collect()
}

//! A made-up world: agents that walk circles which overlap, with noisy odometry and loops.
#![allow(dead_code, reason = "each test file uses its own part")]

use coma_geometry::{AgentId, Epoch, Matrix6, Pose, SubmapId, Tangent, se3};
use coma_pose_graph::{Component, Edge, EdgeKey, EdgeKind, GraphEntries, NodeInfo};
use std::collections::BTreeMap;
use std::path::PathBuf;

pub const ODOMETRY_SIGMA: (f64, f64) = (0.01, 0.004);
pub const LOOP_SIGMA: (f64, f64) = (0.01, 0.005);

pub struct Random(pub u64);

impl Random {
    pub fn uniform(&mut self) -> f64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((z ^ (z >> 31)) >> 11) as f64 / (1u64 << 53) as f64
    }

    pub fn normal(&mut self) -> f64 {
        let radius = (-2.0 * (1.0 - self.uniform()).ln()).sqrt();
        radius * (std::f64::consts::TAU * self.uniform()).cos()
    }

    pub fn below(&mut self, n: usize) -> usize {
        ((self.uniform() * n as f64) as usize).min(n - 1)
    }

    pub fn tangent(&mut self, (sigma_m, sigma_rad): (f64, f64)) -> Tangent {
        Tangent::from_fn(|k, _| self.normal() * if k < 3 { sigma_m } else { sigma_rad })
    }

    /// Rotation uniform, translation uniform in a cube of this half side.
    pub fn any_pose(&mut self, half_side_m: f64) -> Pose {
        let q = nalgebra::Quaternion::new(self.normal(), self.normal(), self.normal(), self.normal());
        let t = Tangent::from_fn(|_, _| (2.0 * self.uniform() - 1.0) * half_side_m);
        Pose::from_parts(
            nalgebra::Translation3::new(t[0], t[1], t[2]),
            nalgebra::UnitQuaternion::from_quaternion(q),
        )
    }

    pub fn shuffle<T>(&mut self, items: &mut [T]) {
        for k in (1..items.len()).rev() {
            items.swap(k, self.below(k + 1));
        }
    }
}

pub fn information((sigma_m, sigma_rad): (f64, f64)) -> Matrix6 {
    Matrix6::from_diagonal(&Tangent::from_fn(|k, _| if k < 3 { sigma_m } else { sigma_rad }.powi(-2)))
}

pub fn agent(name: &str) -> AgentId {
    AgentId::new(name).unwrap()
}

pub fn submap(name: &str, number: u32) -> SubmapId {
    SubmapId { agent: agent(name), epoch: Epoch(0), number }
}

pub struct World {
    pub random: Random,
    pub world_from_submap: BTreeMap<SubmapId, Pose>,
    pub entries: GraphEntries,
    pub false_loops: Vec<EdgeKey>,
    next: BTreeMap<AgentId, u64>,
}

impl World {
    pub fn new(seed: u64) -> Self {
        World {
            random: Random(seed),
            world_from_submap: BTreeMap::new(),
            entries: GraphEntries::default(),
            false_loops: Vec::new(),
            next: BTreeMap::new(),
        }
    }

    pub fn key(&mut self, name: &str) -> EdgeKey {
        let next = self.next.entry(agent(name)).or_insert(0);
        *next += 1;
        EdgeKey { agent: agent(name), epoch: Epoch(0), sequence: *next - 1 }
    }

    /// Walks on by `count` submaps along a circle of 4 m around (`centre`, 0), half a metre each.
    pub fn walk(&mut self, name: &str, centre: f64, count: u32) {
        let first = self.entries.nodes.keys().filter(|s| s.agent == agent(name)).count() as u32;
        for number in first..first + count {
            let angle = 0.125 * f64::from(number) + centre;
            let pose = Pose::translation(centre + 4.0 * angle.cos(), 4.0 * angle.sin(), 0.0)
                * se3::exp(&Tangent::new(0.0, 0.0, 0.0, 0.1, 0.0, angle));
            self.world_from_submap.insert(submap(name, number), pose);
            let mut agent_from_submap = Pose::identity();
            if number > 0 {
                let before = submap(name, number - 1);
                let measured = self.world_from_submap[&before].inverse()
                    * pose
                    * se3::exp(&self.random.tangent(ODOMETRY_SIGMA));
                agent_from_submap = self.entries.nodes[&before].agent_from_submap * measured;
                let edge = Edge {
                    key: self.key(name),
                    kind: EdgeKind::Odometry,
                    from: before,
                    to: submap(name, number),
                    from_from_to: measured,
                    information: information(ODOMETRY_SIGMA),
                };
                self.entries.edges.push(edge);
            }
            let node = NodeInfo { first_frame: u64::from(number) * 21, agent_from_submap };
            self.entries.nodes.insert(submap(name, number), node);
        }
    }

    pub fn measured_loop(&mut self, (a, i): (&str, u32), (b, j): (&str, u32)) -> EdgeKey {
        let (from, to) = (submap(a, i), submap(b, j));
        let truth = self.world_from_submap[&from].inverse() * self.world_from_submap[&to];
        let measured = truth * se3::exp(&self.random.tangent(LOOP_SIGMA));
        self.push_loop(a, from, to, measured)
    }

    pub fn false_loop(&mut self, (a, i): (&str, u32), (b, j): (&str, u32)) -> EdgeKey {
        let measured = self.random.any_pose(6.0);
        let key = self.push_loop(a, submap(a, i), submap(b, j), measured);
        self.false_loops.push(key.clone());
        key
    }

    fn push_loop(&mut self, author: &str, from: SubmapId, to: SubmapId, from_from_to: Pose) -> EdgeKey {
        let key = self.key(author);
        let information = information(LOOP_SIGMA);
        let kind = EdgeKind::Loop;
        self.entries.edges.push(Edge { key: key.clone(), kind, from, to, from_from_to, information });
        key
    }

    /// Largest error in metres and radians of a component's poses, in its own frame.
    pub fn worst_error(&self, component: &Component) -> (f64, f64) {
        let world_from_map = self.world_from_submap[&component.gauge];
        component.map_from_submap.iter().fold((0.0, 0.0), |(m, rad): (f64, f64), (submap, pose)| {
            let (dm, drad) = se3::distance(&(world_from_map * pose), &self.world_from_submap[submap]);
            (m.max(dm), rad.max(drad))
        })
    }
}

/// The folder with the shared data: `COMA_SHARED`, or a folder `shared` beside one of the parents.
pub fn shared_data() -> PathBuf {
    if let Some(root) = std::env::var_os("COMA_SHARED") {
        return PathBuf::from(root).join("data");
    }
    PathBuf::from(env!("CARGO_MANIFEST_DIR"))
        .ancestors()
        .map(|p| p.join("shared/data"))
        .find(|p| p.is_dir())
        .expect("the shared data folder: set COMA_SHARED")
}

use coma_geometry::Pose;
use coma_pose_graph::blocks::{BlockSettings, Network, Simulation, cut::blocks_of};
use coma_pose_graph::g2o::{G2oGraph, G2oLimits};
use coma_pose_graph::SolverSettings;
use coma_pose_graph::initialise::chordal;
fn env<T: std::str::FromStr>(k: &str, d: T) -> T { std::env::var(k).ok().and_then(|s| s.parse().ok()).unwrap_or(d) }
fn main() {
  let file = std::env::args().nth(1).unwrap();
  let path = std::path::PathBuf::from(&file);
  let mut files = vec![path.clone()];
  if path.is_dir() { files = std::fs::read_dir(&path).unwrap().map(|f| f.unwrap().path()).collect(); files.sort(); }
  let graphs: Vec<_> = files.iter().map(|f| G2oGraph::parse_part(&std::fs::read_to_string(f).unwrap(), &G2oLimits::default()).unwrap()).collect();
  let graph = coma_pose_graph::team::merged(&graphs).unwrap();
  let (problem, given) = graph.problem();
  let weights = vec![1.0; problem.constraints.len()];
  let start = chordal(&problem, &given, &weights).unwrap();
  let t = std::time::Instant::now();
  let solved = problem.solve(&start, &weights, &SolverSettings::default()).unwrap();
  let goal = solved.cost;
  println!("central {goal:.3} in {} steps {:?}", solved.iterations, t.elapsed());
  let blocks: usize = env("BLOCKS", 0);
  let of: Vec<u32> = (0..problem.nodes).map(|n| if blocks > 0 { n*blocks/problem.nodes } else { n / 100 } as u32).collect();
  let cut = blocks_of(&problem, &weights, &vec![false; weights.len()], &of);
  let nb: usize = cut.iter().map(|b| { let mut v: Vec<u32> = b.neighbours.values().copied().collect(); v.sort(); v.dedup(); v.len() }).sum();
  println!("mean neighbours {}", nb as f64 / cut.len() as f64);
  let settings = BlockSettings { most_momentum: env("MOM", 0.5), coarse_every: env("RIGID", 6), coarse_points: env("POINTS", 128), iterations_per_step: env("ITER", 3), ..BlockSettings::default() };
  let net = Network { loss: env("LOSS", 0.0), repeated: 0.05, delay_rounds: env("DELAY", 1.0), seed: 1 };
  let mut sim = Simulation::new(cut, |n| solved.poses[n as usize], settings, net);
  let rounds: u64 = env("ROUNDS", 400); let print: u64 = env("PRINT", 10);
  let mut cpu = std::time::Duration::ZERO; 
  while sim.rounds() < rounds && !sim.is_settled() {
    let t = std::time::Instant::now();
    sim.round().unwrap(); cpu += t.elapsed();
    let r = sim.rounds();
    let poses: Option<Vec<Pose>> = sim.poses(problem.nodes).into_iter().collect();
    let Some(poses) = poses else { if r % print == 0 { println!("{r} not placed {:?}", cpu); } continue };
    let excess = problem.cost(&poses, &weights)/goal - 1.0;
    let lo = sim.agents().iter().map(|a| a.coarse_rounds()).min().unwrap(); let hi = sim.agents().iter().map(|a| a.coarse_rounds()).max().unwrap();
    if r % print == 0 || excess <= 1e-3 { print!("{lo}-{hi} "); println!("{r} {:.4} %  {:.1} kB/agent {} coarse {:?}", excess*100.0, sim.traffic.bytes as f64 / 1e3 / sim.agents().len() as f64, sim.agents()[0].coarse_rounds(), cpu); }
    if excess <= 1e-3 { break; }
  }
}

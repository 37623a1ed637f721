use coma_geometry::*;
use coma_slam::agent::*;
use std::sync::Arc;
fn main() {
    let a: Vec<String> = std::env::args().collect();
    let seq = coma_dataset::spec::open(&a[1].parse().unwrap()).unwrap();
    let settings =
        a.get(2).map_or(SlamSettings::default(), |t| toml::from_str(&t.replace(';', "\n")).unwrap());
    let mut agent = Agent::new(AgentId::new("a").unwrap(), Epoch(1), None, settings);
    for i in 0..seq.len() {
        let frame = Arc::new(coma_dataset::sequence::rgbd_frame(&*seq, i).unwrap());
        let o = agent.on_frame(frame, FrameOptions::default());
        if let (Some(p), Some(t)) = (&o.pose, seq.truth(i)) {
            let f = |p: &Pose| {
                let t = p.translation.vector;
                let q = p.rotation;
                format!("{} {} {} {} {} {} {}", t.x, t.y, t.z, q.i, q.j, q.k, q.w)
            };
            println!("{i} {} {} {} {}", p.submap.number, f(&p.agent_from_camera), f(&t), o.share);
        }
    }
}

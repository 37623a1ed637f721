//! Writes pictures of the built-in world: `cargo run --release -p coma-dataset --example world_pictures -- DIR`.

use coma_dataset::world::{World, WorldSettings};
use coma_dataset::{ColorBytes, DepthBytes, Sequence};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let folder = std::env::args().nth(1).ok_or("a folder is needed")?;
    std::fs::create_dir_all(&folder)?;
    let start = std::time::Instant::now();
    let noise = std::env::args().nth(2).map(|_| Default::default());
    let world = World::new(WorldSettings { agents: 4, frames: 800, noise, ..Default::default() })?;
    println!("{} objects, built in {:?}", world.scene().objects.len(), start.elapsed());
    for agent in 0..4 {
        let sequence = world.sequence(agent).ok_or("no such agent")?;
        for index in (0..600).step_by(50) {
            let start = std::time::Instant::now();
            let frame = sequence.frame(index)?;
            if index == 100 {
                println!("agent {agent}: {:?} a frame", start.elapsed());
            }
            if let (ColorBytes::Rgb8(color), DepthBytes::Raw16(depth)) = (frame.color, frame.depth) {
                let bytes: Vec<u8> = color.pixels().iter().flatten().copied().collect();
                let (width, height) = (color.width() as u32, color.height() as u32);
                let path = format!("{folder}/agent-{agent}-{index:04}.png");
                image::save_buffer(path, &bytes, width, height, image::ExtendedColorType::Rgb8)?;
                let bytes: Vec<u8> = depth.pixels().iter().map(|d| (d / 150).min(255) as u8).collect();
                let path = format!("{folder}/depth-{agent}-{index:04}.png");
                image::save_buffer(path, &bytes, width, height, image::ExtendedColorType::L8)?;
            }
        }
        let lines = (0..800).filter_map(|i| sequence.truth(i)).map(|p| {
            let forward = p.rotation * coma_geometry::nalgebra::Vector3::z();
            let t = p.translation.vector;
            format!("{} {} {} {} {}\n", t.x, t.y, t.z, forward.x, forward.y)
        });
        std::fs::write(format!("{folder}/walk-{agent}.txt"), lines.collect::<String>())?;
    }
    Ok(())
}

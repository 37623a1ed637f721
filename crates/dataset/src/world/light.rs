//! Light, computed once: how bright every patch of every surface is.
//!
//! Lamps and windows shine with soft shadows, corners are dimmed by what stands near them. Nothing
//! depends on the viewer, so the same point has the same colour in every frame.

use super::noise::{hash, unit};
use super::scene::{Object, Scene, SurfacePoint, V3};
use rayon::prelude::*;

/// A round lamp or window that sends light.
#[derive(Clone, Copy, Debug)]
pub struct LightSource {
    /// Metres in the world.
    pub centre: V3,
    /// Metres.
    pub radius: f32,
    /// Brightness at one metre.
    pub power: f32,
}

/// Brightness on a grid over each face of each object.
#[derive(Clone, Debug)]
pub struct LightMap {
    /// Per object, the index of its first face in `faces`.
    first_face: Vec<u32>,
    /// Per face: first node in `nodes`, nodes along a, nodes along b.
    faces: Vec<(u32, u16, u16)>,
    nodes: Vec<f32>,
}

/// Distance between light nodes, metres.
const NODE_M: f32 = 0.14;
/// Rays towards each light source, and rays that look for near surfaces.
const SHADOW_RAYS: u32 = 4;
const CORNER_RAYS: u32 = 12;
/// Surfaces nearer than this dim a corner, metres.
const CORNER_M: f32 = 0.7;
/// Light that comes from everywhere.
const AMBIENT: f32 = 0.42;

impl LightMap {
    /// Lights a scene.
    pub fn new(scene: &Scene, sources: &[LightSource]) -> Self {
        let (mut first_face, mut faces, mut total) = (Vec::new(), Vec::new(), 0u32);
        let mut points = Vec::new();
        for object in &scene.objects {
            first_face.push(faces.len() as u32);
            for (face, half) in object.faces().into_iter().enumerate() {
                let nodes = |half: f32| ((2.0 * half / NODE_M).ceil() as u16 + 1).clamp(2, 200);
                let (na, nb) = (nodes(half.0), nodes(half.1));
                faces.push((total, na, nb));
                total += na as u32 * nb as u32;
                for j in 0..nb {
                    for i in 0..na {
                        // Nodes at the rim look from slightly inside it.
                        let along = |i: u16, n: u16| (2.0 * i as f32 / (n - 1) as f32 - 1.0) * 0.985;
                        points.push(object.point_on_face(
                            face as u8,
                            along(i, na) * half.0,
                            along(j, nb) * half.1,
                        ));
                    }
                }
            }
        }
        let nodes = points
            .par_iter()
            .enumerate()
            .map(|(i, (point, normal))| brightness(scene, sources, point, normal, i as u32))
            .collect();
        LightMap { first_face, faces, nodes }
    }

    /// Brightness at a surface point of object number `index`.
    #[inline]
    pub fn at(&self, index: u32, object: &Object, point: &SurfacePoint) -> f32 {
        if object.material.shines() {
            return 1.6;
        }
        let (first, na, nb) = self.faces[(self.first_face[index as usize] + point.face as u32) as usize];
        let place = |x: f32, half: f32, n: u16| {
            let s = ((x / half + 1.0) * 0.5 * (n - 1) as f32).clamp(0.0, (n - 1) as f32 - 1e-3);
            (s as u32, s.fract())
        };
        let (i, fa) = place(point.a, point.half.0, na);
        let (j, fb) = place(point.b, point.half.1, nb);
        let node = |i: u32, j: u32| self.nodes[(first + j * na as u32 + i) as usize];
        let low = node(i, j) * (1.0 - fa) + node(i + 1, j) * fa;
        let high = node(i, j + 1) * (1.0 - fa) + node(i + 1, j + 1) * fa;
        low * (1.0 - fb) + high * fb
    }
}

fn brightness(scene: &Scene, sources: &[LightSource], point: &V3, normal: &V3, seed: u32) -> f32 {
    let from = point + normal * 0.006;
    let mut free = 0.0;
    for ray in 0..CORNER_RAYS {
        // Directions spread over the hemisphere by their cosine (Malley's method).
        let radius = ((ray as f32 + 0.5) / CORNER_RAYS as f32).sqrt();
        let angle = ray as f32 * 2.399_963 + unit(seed, 3) * std::f32::consts::TAU;
        let (tangent, bitangent) = frame(normal);
        let direction = tangent * (radius * angle.cos())
            + bitangent * (radius * angle.sin())
            + normal * (1.0 - radius * radius).max(0.0).sqrt();
        free += scene.free_share(&from, &direction, CORNER_M).min(1.0);
    }
    free /= CORNER_RAYS as f32;
    let mut light = AMBIENT * free;
    for (number, source) in sources.iter().enumerate() {
        let middle = source.centre - from;
        let distance2 = middle.norm_squared();
        if distance2 > 64.0 {
            continue;
        }
        let mut seen = 0.0;
        for ray in 0..SHADOW_RAYS {
            let word = hash(seed, (number as u32) << 8 | ray);
            let jitter = V3::new(unit(word, 1) - 0.5, unit(word, 2) - 0.5, unit(word, 3) - 0.5);
            let direction = middle + jitter * (2.0 * source.radius);
            let length = direction.norm();
            let cosine = normal.dot(&direction) / length;
            if cosine > 0.0 && scene.free_share(&from, &(direction / length), length) >= 0.999 {
                seen += cosine;
            }
        }
        light += source.power * seen / SHADOW_RAYS as f32 / (distance2 + 0.6);
    }
    0.06 + light
}

fn frame(normal: &V3) -> (V3, V3) {
    let other = if normal.z.abs() < 0.9 { V3::z() } else { V3::x() };
    let tangent = normal.cross(&other).normalize();
    (tangent, normal.cross(&tangent))
}

//! Where the agents walk: smooth closed tours, carried by a hand that shakes a little.
//!
//! Every tour starts in a place of its own and reaches the middle of the living room within about 100
//! frames, so that all agents look there in similar directions; then it goes on through the rooms and
//! comes back to its start.

use super::noise::{hash, unit};
use coma_geometry::Pose;
use nalgebra::{Matrix3, Rotation3, Translation3, UnitQuaternion, Vector3};

/// A place on a tour: position (m, world) and where the camera looks.
#[derive(Clone, Copy, Debug)]
struct Stop {
    x: f64,
    y: f64,
    z: f64,
    /// Degrees from east, counter-clockwise. Runs on beyond 360.
    yaw: f64,
    /// Degrees; negative looks down.
    pitch: f64,
}

const fn stop(x: f64, y: f64, z: f64, yaw: f64, pitch: f64) -> Stop {
    Stop { x, y, z, yaw, pitch }
}

/// Closed tours; the yaw of a tour may gain or lose whole turns per round.
const TOURS: [&[Stop]; 4] = [
    // Starts in the west of the living room, looks at armchair and sofa, turns to the west wall.
    &[
        stop(1.50, 3.35, 1.40, 305.0, -14.0),
        stop(2.10, 3.20, 1.42, 290.0, -15.0),
        stop(2.75, 3.00, 1.45, 270.0, -14.0),
        stop(3.25, 2.90, 1.42, 242.0, -14.0),
        stop(3.55, 2.85, 1.38, 215.0, -13.0),
        stop(3.85, 2.72, 1.40, 188.0, -12.0),
        stop(3.45, 2.65, 1.42, 155.0, -12.0),
        stop(2.80, 2.60, 1.40, 115.0, -12.0),
        stop(2.20, 2.75, 1.42, 75.0, -13.0),
        stop(1.80, 3.00, 1.45, 30.0, -13.0),
        stop(1.50, 3.25, 1.42, -15.0, -13.0),
    ],
    // Starts in the study, comes through the opening, sees the living room from there.
    &[
        stop(5.85, 2.15, 1.45, 136.0, -11.0),
        stop(5.50, 2.20, 1.45, 155.0, -11.0),
        stop(5.05, 2.35, 1.42, 174.0, -12.0),
        stop(4.45, 2.55, 1.40, 186.0, -12.0),
        stop(3.90, 2.70, 1.38, 202.0, -12.0),
        stop(3.45, 2.85, 1.40, 226.0, -13.0),
        stop(3.15, 2.90, 1.44, 255.0, -14.0),
        stop(3.20, 2.75, 1.45, 290.0, -14.0),
        stop(3.60, 2.50, 1.42, 325.0, -12.0),
        stop(4.30, 2.35, 1.42, 352.0, -11.0),
        stop(5.05, 2.25, 1.40, 368.0, -11.0),
        stop(5.80, 2.20, 1.42, 390.0, -12.0),
        stop(6.35, 2.30, 1.45, 425.0, -12.0),
        stop(6.30, 2.30, 1.45, 460.0, -11.0),
    ],
    // Starts in the corridor, comes through the door.
    &[
        stop(3.70, 5.15, 1.45, 168.0, -11.0),
        stop(3.68, 4.85, 1.45, 190.0, -12.0),
        stop(3.66, 4.40, 1.45, 214.0, -13.0),
        stop(3.62, 3.85, 1.43, 230.0, -14.0),
        stop(3.55, 3.35, 1.42, 240.0, -14.0),
        stop(3.55, 2.92, 1.40, 222.0, -13.0),
        stop(3.65, 2.65, 1.40, 198.0, -12.0),
        stop(3.35, 2.55, 1.42, 218.0, -13.0),
        stop(3.15, 2.80, 1.44, 256.0, -14.0),
        stop(3.45, 3.05, 1.44, 296.0, -13.0),
        stop(3.60, 3.20, 1.44, 340.0, -12.0),
        stop(3.65, 3.60, 1.44, 385.0, -12.0),
        stop(3.68, 4.20, 1.45, 425.0, -12.0),
        stop(3.70, 4.85, 1.45, 465.0, -12.0),
        stop(3.72, 5.25, 1.45, 500.0, -11.0),
    ],
    // Starts by the armchair, looks at shelf and door, turns to the west and the sofa.
    &[
        stop(4.15, 1.85, 1.42, 110.0, -11.0),
        stop(4.15, 2.10, 1.42, 135.0, -11.0),
        stop(4.05, 2.40, 1.40, 162.0, -12.0),
        stop(3.85, 2.65, 1.38, 188.0, -12.0),
        stop(3.60, 2.80, 1.40, 214.0, -13.0),
        stop(3.30, 2.85, 1.42, 244.0, -14.0),
        stop(3.20, 2.70, 1.44, 276.0, -14.0),
        stop(3.50, 2.40, 1.44, 312.0, -12.0),
        stop(3.90, 2.10, 1.42, 352.0, -11.0),
        stop(4.15, 1.75, 1.42, 392.0, -11.0),
        stop(4.20, 1.70, 1.42, 432.0, -11.0),
    ],
];

/// The largest number of agents that have a tour.
pub const MAX_AGENTS: usize = 8;
/// Metres and degrees per frame that a hand-held camera makes.
const STEP_M: f64 = 0.0150;
const STEP_DEG: f64 = 0.75;
/// Points per tour between which its length is measured.
const SAMPLES: usize = 4000;

/// One agent's walk. The same for every number of agents.
#[derive(Clone, Debug)]
pub struct Tour {
    stops: Vec<Stop>,
    /// Effort (frames) used up at each of [`SAMPLES`] + 1 even places of the spline.
    effort: Vec<f64>,
    /// Degrees of yaw that one round adds.
    turn_deg: f64,
    seed: u32,
}

impl Tour {
    /// The tour of agent number `agent` (below [`MAX_AGENTS`]). The seed changes how the hand shakes.
    pub fn new(agent: usize, seed: u64) -> Self {
        let seed = hash(hash(seed as u32, (seed >> 32) as u32), agent as u32 + 77);
        let round = (agent / TOURS.len()) as f64;
        let mut stops = TOURS[agent % TOURS.len()].to_vec();
        for stop in &mut stops {
            // Later agents walk beside the first ones, a little lower, and look a little aside.
            stop.y -= 0.12 * round;
            stop.z -= 0.08 * round;
            stop.yaw += 5.0 * round;
        }
        let (first, last) = (stops[0].yaw, stops[stops.len() - 1].yaw);
        // Whole turns, to the side on which the last stop lies.
        let turn_deg = 360.0 * ((last - first) / 360.0).abs().ceil() * (last - first).signum();
        let mut tour = Tour { stops, effort: vec![0.0], turn_deg, seed };
        let mut total = 0.0;
        let mut before = tour.on_spline(0.0);
        for i in 1..=SAMPLES {
            let now = tour.on_spline(i as f64 / SAMPLES as f64);
            let metres = (now.x - before.x).hypot(now.y - before.y).hypot(now.z - before.z);
            let degrees = (now.yaw - before.yaw).hypot(now.pitch - before.pitch);
            // The larger of both, rounded at the corner so that the speed changes smoothly.
            total += ((metres / STEP_M).powi(4) + (degrees / STEP_DEG).powi(4)).powf(0.25);
            tour.effort.push(total);
            before = now;
        }
        tour
    }

    /// Frames of one round.
    pub fn round_frames(&self) -> f64 {
        self.effort[SAMPLES]
    }

    /// The camera's pose in frame `frame`; the walk goes round and round.
    pub fn world_from_camera(&self, frame: usize) -> Pose {
        let t = frame as f64;
        // A walk is never quite even.
        let along = t + 4.0 * ((t / 37.0 + self.phase(1)).sin() - self.phase(1).sin());
        let round = (along / self.round_frames()).floor();
        let within = along - round * self.round_frames();
        let after = self.effort.partition_point(|e| *e <= within).clamp(1, SAMPLES);
        let (e0, e1) = (self.effort[after - 1], self.effort[after]);
        let share = if e1 > e0 { (within - e0) / (e1 - e0) } else { 0.0 };
        let place = self.on_spline((after as f64 - 1.0 + share) / SAMPLES as f64);
        let shake = |salt: u32, size: f64| {
            size * ((t / 11.3 + self.phase(salt)).sin() * 0.35
                + (t / 7.1 + self.phase(salt + 1)).sin() * 0.2
                + (t / 23.0 + self.phase(salt + 2)).sin())
        };
        let position =
            Vector3::new(place.x + shake(10, 0.008), place.y + shake(20, 0.008), place.z + shake(30, 0.012));
        let yaw = (place.yaw + round * self.turn_deg + shake(40, 0.7)).to_radians();
        let pitch = (place.pitch + shake(50, 0.8)).to_radians();
        let roll = shake(60, 1.2).to_radians();
        Pose::from_parts(Translation3::from(position), looking(yaw, pitch, roll))
    }

    fn phase(&self, salt: u32) -> f64 {
        unit(self.seed, salt) as f64 * std::f64::consts::TAU
    }

    /// A point of the closed spline (uniform Catmull-Rom), `s` in 0..1.
    fn on_spline(&self, s: f64) -> Stop {
        let count = self.stops.len() as i64;
        let scaled = s * count as f64;
        let i = scaled.floor() as i64;
        let t = scaled - i as f64;
        let at = |k: i64| {
            let mut stop = self.stops[k.rem_euclid(count) as usize];
            stop.yaw += self.turn_deg * k.div_euclid(count) as f64;
            stop
        };
        let (p0, p1, p2, p3) = (at(i - 1), at(i), at(i + 1), at(i + 2));
        let blend = |f: fn(&Stop) -> f64| {
            let (a, b, c, d) = (f(&p0), f(&p1), f(&p2), f(&p3));
            0.5 * (2.0 * b
                + (c - a) * t
                + (2.0 * a - 5.0 * b + 4.0 * c - d) * t * t
                + (3.0 * b - a - 3.0 * c + d) * t * t * t)
        };
        stop(blend(|p| p.x), blend(|p| p.y), blend(|p| p.z), blend(|p| p.yaw), blend(|p| p.pitch))
    }
}

/// World from camera (x right, y down, z forward) for a camera that looks along yaw and pitch.
fn looking(yaw_rad: f64, pitch_rad: f64, roll_rad: f64) -> UnitQuaternion<f64> {
    let forward =
        Vector3::new(yaw_rad.cos() * pitch_rad.cos(), yaw_rad.sin() * pitch_rad.cos(), pitch_rad.sin());
    let right = forward.cross(&Vector3::z()).normalize();
    let down = forward.cross(&right);
    let level = Rotation3::from_matrix_unchecked(Matrix3::from_columns(&[right, down, forward]));
    UnitQuaternion::from_rotation_matrix(&level)
        * UnitQuaternion::from_axis_angle(&Vector3::z_axis(), roll_rad)
}

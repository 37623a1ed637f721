//! The furnished rooms: a living room, a study, and a corridor that joins them.
//!
//! World axes: x east, y north, z up, metres. Living room x 0..5, y 0..4.5; study x 5.2..9.2, y 0..4.5;
//! a wide opening between them; corridor y 4.7..6.2 behind both, with a door to each.

use super::light::LightSource;
use super::material::{Material, Rgb, palette};
use super::noise::{hash, unit};
use super::scene::{Object, Shape, V3};

const OAK: Material = Material::Wood([0.52, 0.34, 0.18], [0.30, 0.17, 0.08], 0.11, true);
const WALNUT: Material = Material::Wood([0.30, 0.17, 0.09], [0.13, 0.07, 0.04], 0.16, true);
const PINE: Material = Material::Wood([0.70, 0.54, 0.33], [0.52, 0.36, 0.19], 0.14, true);
const WHITE_WOOD: Material = Material::Wood([0.74, 0.72, 0.67], [0.60, 0.58, 0.53], 0.2, false);
const CREAM: Material = Material::Plaster([0.66, 0.60, 0.49]);
const SAGE: Material = Material::Plaster([0.42, 0.50, 0.40]);
const CLAY: Material = Material::Plaster([0.58, 0.38, 0.28]);
const SKY: Material = Material::Plaster([0.40, 0.50, 0.58]);
const CEILING: Material = Material::Plaster([0.78, 0.77, 0.74]);
const HEIGHT_M: f32 = 2.6;

/// Collects objects; every object gets its own texture seed.
struct Builder {
    objects: Vec<Object>,
    seed: u32,
}

impl Builder {
    fn put(&mut self, centre: V3, turn_deg: f32, shape: Shape, material: Material) {
        let turn = (turn_deg.to_radians().cos(), turn_deg.to_radians().sin());
        let seed = hash(self.seed, self.objects.len() as u32 + 1);
        self.objects.push(Object { centre, turn, shape, material, seed });
    }

    /// An upright box between two corners.
    fn block(&mut self, low: [f32; 3], high: [f32; 3], material: Material) {
        let (low, high) = (V3::from(low), V3::from(high));
        self.put((low + high) * 0.5, 0.0, Shape::Block((high - low) * 0.5), material);
    }

    /// A box by its floor centre, size and turn.
    fn turned(&mut self, base: [f32; 3], size: [f32; 3], turn_deg: f32, material: Material) {
        let half = V3::from(size) * 0.5;
        self.put(V3::from(base) + V3::new(0.0, 0.0, half.z), turn_deg, Shape::Block(half), material);
    }

    fn drum(&mut self, base: [f32; 3], radius: f32, height: f32, material: Material) {
        let centre = V3::from(base) + V3::new(0.0, 0.0, height * 0.5);
        self.put(centre, 0.0, Shape::Drum(radius, height * 0.5), material);
    }

    fn ball(&mut self, centre: [f32; 3], radius: f32, material: Material) {
        self.put(V3::from(centre), 0.0, Shape::Ball(radius), material);
    }

    fn word(&self, salt: u32) -> u32 {
        hash(hash(self.seed, self.objects.len() as u32), salt)
    }

    fn random(&self, salt: u32) -> f32 {
        unit(self.word(salt), 1)
    }

    /// A framed picture: `low` and `high` span the frame on a wall; the side of the least extent is its
    /// thickness.
    fn picture(&mut self, low: [f32; 3], high: [f32; 3], frame: Material) {
        let (l, h) = (V3::from(low), V3::from(high));
        let thin = (h - l).imin();
        self.block(low, high, frame);
        // The painting stands 4 mm proud of its frame on both sides, so that it shows on the room's side.
        let (mut pl, mut ph) = (l, h);
        for i in 0..3 {
            let inset = if i == thin { -0.004 } else { 0.035 };
            pl[i] += inset;
            ph[i] -= inset;
        }
        self.block(pl.into(), ph.into(), Material::Picture);
    }

    /// A shelf full of books and small things, its open side towards `facing` (0 east, 90 north, ...).
    /// `base` is the floor point at the middle of its back.
    fn bookshelf(&mut self, base: [f32; 3], width: f32, height: f32, facing_deg: f32, wood: Material) {
        let depth = 0.30;
        let (c, s) = (facing_deg.to_radians().cos(), facing_deg.to_radians().sin());
        // Own axes: out of the wall, along the wall.
        let at = |out: f32, along: f32, z: f32| {
            [base[0] + c * out - s * along, base[1] + s * out + c * along, base[2] + z]
        };
        self.turned(at(0.01, 0.0, 0.0), [0.02, width, height], facing_deg, wood);
        for side in [-1.0, 1.0] {
            self.turned(
                at(depth * 0.5, side * (width * 0.5 - 0.0125), 0.0),
                [depth, 0.025, height],
                facing_deg,
                wood,
            );
        }
        let shelves = ((height - 0.06) / 0.36).round() as u32;
        let pitch = (height - 0.05) / shelves as f32;
        for shelf in 0..=shelves {
            let z = shelf as f32 * pitch;
            self.turned(at(depth * 0.5, 0.0, z), [depth - 0.01, width - 0.05, 0.025], facing_deg, wood);
            if shelf == shelves {
                break;
            }
            let mut along = -width * 0.5 + 0.035;
            let end = width * 0.5 - 0.035;
            let mut number = 0;
            while along < end - 0.02 {
                number += 1;
                let r = self.random(number);
                if r < 0.10 {
                    along += 0.04 + 0.12 * self.random(number + 100);
                    continue;
                }
                if r < 0.16 && along < end - 0.14 {
                    let tone = palette(self.word(7));
                    let rings = Material::Ceramic(tone, palette(self.word(8)));
                    self.drum(at(0.15, along + 0.07, z + 0.025), 0.055, 0.10 + 0.1 * self.random(9), rings);
                    along += 0.15;
                    continue;
                }
                let thick = (0.02 + 0.035 * self.random(number + 200)).min(end - along);
                let tall = (0.19 + 0.10 * self.random(number + 300)).min(pitch - 0.04);
                let deep = 0.16 + 0.08 * self.random(number + 400);
                let book = Material::Book(palette(self.word(number + 500)));
                self.turned(
                    at(deep * 0.5 + 0.02, along + thick * 0.5, z + 0.025),
                    [deep, thick - 0.002, tall],
                    facing_deg,
                    book,
                );
                along += thick;
            }
        }
    }

    fn plant(&mut self, base: [f32; 3], height: f32) {
        let [x, y, z] = base;
        self.drum(base, 0.17, 0.30, Material::Ceramic([0.55, 0.28, 0.18], [0.66, 0.50, 0.36]));
        self.drum([x, y, z + 0.3], 0.02, height - 0.5, WALNUT);
        for i in 0..9 {
            let angle = i as f32 * 2.4;
            let reach = 0.10 + 0.12 * self.random(1);
            let up = z + 0.5 + (height - 0.6) * (i as f32 / 8.0);
            let green: Rgb = [0.10 + 0.08 * self.random(2), 0.28 + 0.14 * self.random(3), 0.09];
            let radius = 0.08 + 0.07 * self.random(4);
            self.ball(
                [x + reach * angle.cos(), y + reach * angle.sin(), up],
                radius,
                Material::Leaves(green),
            );
        }
    }

    fn table(&mut self, centre: [f32; 2], size: [f32; 2], height: f32, turn_deg: f32, wood: Material) {
        let [x, y] = centre;
        self.turned([x, y, height - 0.04], [size[0], size[1], 0.04], turn_deg, wood);
        let (c, s) = (turn_deg.to_radians().cos(), turn_deg.to_radians().sin());
        for (i, j) in [(-1.0, -1.0), (-1.0, 1.0), (1.0, -1.0), (1.0, 1.0)] {
            let (a, b) = (i * (size[0] * 0.5 - 0.05), j * (size[1] * 0.5 - 0.05));
            self.turned(
                [x + c * a - s * b, y + s * a + c * b, 0.0],
                [0.05, 0.05, height - 0.04],
                turn_deg,
                wood,
            );
        }
    }

    /// A stack of lying books.
    fn stack(&mut self, base: [f32; 3], count: u32) {
        let mut z = base[2];
        for i in 0..count {
            let (thick, turn) = (0.02 + 0.025 * self.random(i), 70.0 * self.random(i + 10) - 35.0);
            let size = [0.15 + 0.06 * self.random(i + 20), 0.21 + 0.06 * self.random(i + 30), thick];
            let cover = Material::Book(palette(self.word(i + 40)));
            self.turned([base[0], base[1], z], size, turn, cover);
            z += thick;
        }
    }

    fn vase(&mut self, base: [f32; 3], radius: f32, height: f32) {
        let glaze = Material::Ceramic(palette(self.word(1)), palette(self.word(2)));
        self.drum(base, radius, height * 0.7, glaze);
        self.drum([base[0], base[1], base[2] + height * 0.7], radius * 0.55, height * 0.3, glaze);
    }

    fn armchair(&mut self, centre: [f32; 2], turn_deg: f32, cloth: Material) {
        let (c, s) = (turn_deg.to_radians().cos(), turn_deg.to_radians().sin());
        let at = |a: f32, b: f32, z: f32| [centre[0] + c * a - s * b, centre[1] + s * a + c * b, z];
        self.turned(at(0.0, 0.0, 0.08), [0.75, 0.62, 0.34], turn_deg, cloth);
        self.turned(at(-0.32, 0.0, 0.42), [0.16, 0.70, 0.45], turn_deg, cloth);
        for side in [-1.0, 1.0] {
            self.turned(at(0.02, side * 0.38, 0.08), [0.72, 0.14, 0.52], turn_deg, cloth);
        }
        let print = Material::Print(palette(self.word(3)), [0.66, 0.60, 0.48]);
        self.turned(at(-0.12, 0.05, 0.42), [0.14, 0.40, 0.36], turn_deg + 8.0, print);
    }
}

fn shell(b: &mut Builder) {
    // Floors and ceiling.
    b.block([-0.2, -0.2, -0.2], [5.1, 4.6, 0.0], OAK);
    b.block([5.1, -0.2, -0.2], [9.4, 4.6, 0.0], WALNUT);
    b.block([-0.2, 4.6, -0.2], [9.4, 6.4, 0.0], Material::Tiles([0.62, 0.58, 0.50], [0.34, 0.30, 0.27], 0.3));
    b.block([-0.2, -0.2, HEIGHT_M], [9.4, 6.4, HEIGHT_M + 0.2], CEILING);
    // Outer walls.
    b.block([-0.2, -0.2, 0.0], [0.0, 4.6, HEIGHT_M], SAGE);
    b.block([-0.2, 4.6, 0.0], [0.0, 6.4, HEIGHT_M], CREAM);
    b.block(
        [0.0, -0.2, 0.0],
        [5.1, 0.0, HEIGHT_M],
        Material::Wallpaper([0.62, 0.56, 0.44], [0.50, 0.46, 0.32]),
    );
    b.block([5.1, -0.2, 0.0], [9.4, 0.0, HEIGHT_M], SKY);
    b.block(
        [9.2, 0.0, 0.0],
        [9.4, 4.6, HEIGHT_M],
        Material::Wallpaper([0.36, 0.44, 0.50], [0.50, 0.55, 0.56]),
    );
    b.block([9.2, 4.6, 0.0], [9.4, 6.4, HEIGHT_M], CLAY);
    b.block([0.0, 6.2, 0.0], [9.2, 6.4, HEIGHT_M], CREAM);
    // Between living room and study, with a wide opening.
    b.block([5.0, 0.0, 0.0], [5.2, 1.3, HEIGHT_M], CLAY);
    b.block([5.0, 3.4, 0.0], [5.2, 4.5, HEIGHT_M], CLAY);
    b.block([5.0, 1.3, 2.2], [5.2, 3.4, HEIGHT_M], CLAY);
    // Between rooms and corridor, with two doors.
    for (x0, x1) in [(0.0, 3.1), (4.2, 7.0), (8.0, 9.2)] {
        b.block([x0, 4.5, 0.0], [x1, 4.7, HEIGHT_M], CREAM);
    }
    for (x0, x1) in [(3.1, 4.2), (7.0, 8.0)] {
        b.block([x0, 4.5, 2.1], [x1, 4.7, HEIGHT_M], CREAM);
        for x in [x0, x1] {
            b.block([x - 0.05, 4.47, 0.0], [x + 0.02, 4.73, 2.1], WHITE_WOOD);
        }
    }
    // Skirting boards.
    b.block([0.0, 0.0, 0.0], [5.0, 0.018, 0.1], WHITE_WOOD);
    b.block([0.0, 0.0, 0.0], [0.018, 4.5, 0.1], WHITE_WOOD);
    b.block([0.0, 4.482, 0.0], [3.1, 4.5, 0.1], WHITE_WOOD);
    b.block([5.2, 0.0, 0.0], [9.2, 0.018, 0.1], WHITE_WOOD);
    b.block([9.182, 0.0, 0.0], [9.2, 4.5, 0.1], WHITE_WOOD);
    b.block([0.0, 6.182, 0.0], [9.2, 6.2, 0.1], WHITE_WOOD);
}

fn living_room(b: &mut Builder) {
    b.block(
        [1.0, 1.05, 0.0],
        [3.8, 2.75, 0.012],
        Material::Carpet([0.40, 0.09, 0.08], [0.60, 0.48, 0.30], [0.10, 0.12, 0.24]),
    );
    // Sofa on the south wall, with cushions.
    let cloth = Material::Fabric([0.30, 0.34, 0.42]);
    b.block([1.15, 0.12, 0.08], [3.35, 0.95, 0.40], cloth);
    b.block([1.15, 0.05, 0.40], [3.35, 0.28, 0.82], cloth);
    for x in [1.02, 3.30] {
        b.block([x, 0.08, 0.08], [x + 0.18, 0.95, 0.58], cloth);
    }
    for (i, x) in [1.45f32, 2.0, 2.62, 3.05].into_iter().enumerate() {
        let print = Material::Print(palette(b.word(i as u32)), [0.68, 0.60, 0.45]);
        b.turned([x, 0.42, 0.40], [0.40, 0.14, 0.38], 14.0 * (i as f32 - 1.4), print);
    }
    // Coffee table and what lies on it.
    b.table([2.25, 1.75], [1.1, 0.6], 0.42, 6.0, WALNUT);
    b.stack([2.0, 1.7, 0.42], 4);
    b.vase([2.55, 1.9, 0.42], 0.07, 0.24);
    b.turned([2.35, 1.58, 0.42], [0.21, 0.29, 0.006], 25.0, Material::Paper);
    b.ball([2.68, 1.66, 0.46], 0.04, Material::Leaves([0.62, 0.30, 0.06]));
    // Sideboard, things and a large picture on the west wall.
    b.block([0.02, 1.0, 0.08], [0.44, 2.9, 0.74], OAK);
    for (y, k) in [(1.02, 0), (1.66, 1), (2.28, 2)] {
        b.block([0.44, y, 0.12], [0.455, y + 0.58, 0.70], if k == 1 { PINE } else { OAK });
    }
    b.vase([0.22, 1.2, 0.74], 0.09, 0.34);
    b.stack([0.24, 1.6, 0.74], 5);
    b.drum([0.22, 2.15, 0.74], 0.05, 0.18, Material::Ceramic([0.66, 0.62, 0.5], [0.14, 0.25, 0.4]));
    b.vase([0.23, 2.6, 0.74], 0.07, 0.26);
    b.picture([0.0, 1.3, 1.15], [0.03, 2.5, 1.95], WALNUT);
    // Window on the west wall, further north.
    b.block([0.0, 3.2, 0.9], [0.02, 4.2, 2.1], Material::Window);
    for (y0, y1, z0, z1) in [
        (3.12, 3.2, 0.82, 2.18),
        (4.2, 4.28, 0.82, 2.18),
        (3.2, 4.2, 0.82, 0.9),
        (3.2, 4.2, 2.1, 2.18),
        (3.67, 3.73, 0.9, 2.1),
    ] {
        b.block([0.0, y0, z0], [0.05, y1, z1], WHITE_WOOD);
    }
    b.block([0.0, 3.1, 0.78], [0.2, 4.3, 0.82], WHITE_WOOD);
    b.vase([0.11, 3.5, 0.82], 0.06, 0.22);
    // Pictures above the sofa.
    b.picture([0.9, 0.0, 1.25], [1.5, 0.03, 2.05], WALNUT);
    b.picture([1.75, 0.0, 1.15], [2.75, 0.03, 1.85], PINE);
    b.picture([3.05, 0.0, 1.35], [3.5, 0.03, 1.95], WALNUT);
    // Floor lamp in the corner.
    b.drum([0.45, 0.45, 0.0], 0.16, 0.03, WALNUT);
    b.drum([0.45, 0.45, 0.03], 0.018, 1.45, WALNUT);
    b.drum([0.45, 0.45, 1.42], 0.19, 0.28, Material::Print([0.72, 0.64, 0.45], [0.60, 0.44, 0.24]));
    // Armchair and small table in the south-east corner.
    b.armchair([4.35, 0.75], 135.0, Material::Fabric([0.46, 0.22, 0.13]));
    b.drum([3.65, 0.45, 0.0], 0.03, 0.5, WALNUT);
    b.drum([3.65, 0.45, 0.5], 0.21, 0.03, WALNUT);
    b.stack([3.65, 0.45, 0.53], 3);
    b.picture([4.97, 0.35, 1.2], [5.0, 1.05, 2.0], PINE);
    // Bookshelf on the north wall, plant, picture by the door.
    b.bookshelf([1.75, 4.5, 0.0], 1.6, 1.95, 270.0, OAK);
    b.stack([1.4, 4.34, 1.95], 4);
    b.vase([2.2, 4.34, 1.95], 0.08, 0.28);
    b.plant([0.5, 4.1, 0.0], 0.8);
    b.plant([4.65, 4.1, 0.0], 1.5);
    b.picture([2.62, 4.47, 1.3], [3.0, 4.5, 1.9], WALNUT);
    b.picture([4.97, 3.55, 1.3], [5.0, 4.0, 1.95], WALNUT);
}

fn study(b: &mut Builder) {
    b.block(
        [5.9, 1.2, 0.0],
        [7.9, 3.2, 0.012],
        Material::Carpet([0.12, 0.22, 0.30], [0.55, 0.52, 0.40], [0.42, 0.16, 0.10]),
    );
    // Desk on the east wall.
    b.table([8.82, 2.0], [0.72, 1.7], 0.74, 0.0, PINE);
    b.turned([8.98, 2.0, 0.74], [0.16, 0.24, 0.02], 0.0, WALNUT);
    b.turned([9.0, 2.0, 0.76], [0.03, 0.05, 0.1], 0.0, WALNUT);
    b.turned([8.97, 2.0, 0.84], [0.035, 0.62, 0.37], 0.0, Material::Screen);
    b.turned([8.7, 2.0, 0.74], [0.15, 0.44, 0.018], 3.0, Material::Paper);
    b.turned([8.72, 1.5, 0.74], [0.21, 0.29, 0.01], 20.0, Material::Paper);
    b.turned([8.8, 2.6, 0.74], [0.29, 0.21, 0.012], -12.0, Material::Paper);
    b.stack([8.95, 1.35, 0.74], 6);
    b.drum([8.62, 2.45, 0.74], 0.04, 0.1, Material::Ceramic([0.6, 0.2, 0.12], [0.7, 0.66, 0.5]));
    b.drum([9.0, 2.62, 0.74], 0.07, 0.02, WALNUT);
    b.drum([9.0, 2.62, 0.76], 0.012, 0.36, WALNUT);
    b.drum([8.95, 2.58, 1.1], 0.1, 0.12, Material::Ceramic([0.1, 0.3, 0.24], [0.1, 0.3, 0.24]));
    // Pin board above it.
    b.block([9.175, 1.2, 1.35], [9.2, 2.8, 2.15], PINE);
    for i in 0..9u32 {
        let (y, z) = (1.3 + 0.5 * (i % 3) as f32, 1.42 + 0.24 * (i / 3) as f32);
        let (dy, dz) = (0.06 * b.random(i), 0.03 * b.random(i + 20));
        let sheet = if i % 4 == 1 { Material::Picture } else { Material::Paper };
        b.block([9.168, y + dy, z + dz], [9.176, y + dy + 0.26, z + dz + 0.19], sheet);
    }
    // Chair.
    b.turned([8.15, 1.95, 0.44], [0.44, 0.44, 0.06], 20.0, Material::Fabric([0.16, 0.26, 0.2]));
    b.drum([8.15, 1.95, 0.06], 0.03, 0.38, WALNUT);
    b.turned([8.15, 1.95, 0.0], [0.5, 0.08, 0.06], 20.0, WALNUT);
    b.turned([8.15, 1.95, 0.0], [0.08, 0.5, 0.06], 20.0, WALNUT);
    b.turned([7.95, 1.88, 0.5], [0.06, 0.42, 0.46], 20.0, Material::Fabric([0.16, 0.26, 0.2]));
    // Shelves on the south wall; dresser on the north wall.
    b.bookshelf([6.3, 0.0, 0.0], 1.5, 2.1, 90.0, WALNUT);
    b.bookshelf([7.95, 0.0, 0.0], 1.3, 1.25, 90.0, WALNUT);
    b.vase([7.6, 0.15, 1.25], 0.08, 0.3);
    b.stack([8.1, 0.15, 1.25], 4);
    b.picture([7.5, 0.0, 1.62], [8.4, 0.03, 2.2], PINE);
    b.block([5.35, 4.05, 0.06], [6.75, 4.5, 0.92], WHITE_WOOD);
    for i in 0..6u32 {
        let (x, z) = (5.38 + 0.69 * (i % 2) as f32, 0.1 + 0.27 * (i / 2) as f32);
        b.block([x, 4.03, z], [x + 0.65, 4.05, z + 0.24], if i % 3 == 0 { PINE } else { WHITE_WOOD });
        b.ball([x + 0.32, 4.02, z + 0.12], 0.018, WALNUT);
    }
    b.vase([5.6, 4.28, 0.92], 0.1, 0.36);
    b.stack([6.0, 4.28, 0.92], 5);
    b.ball([6.45, 4.28, 1.04], 0.12, Material::Picture);
    b.picture([5.5, 4.47, 1.4], [6.7, 4.5, 2.2], WALNUT);
    b.picture([8.2, 4.47, 1.2], [8.9, 4.5, 2.1], PINE);
    b.picture([5.2, 0.4, 1.2], [5.23, 1.1, 1.9], WALNUT);
    b.picture([5.2, 3.6, 1.3], [5.23, 4.0, 1.8], PINE);
    b.plant([8.8, 3.9, 0.0], 1.3);
    b.plant([8.85, 0.45, 0.0], 1.0);
    b.turned([7.2, 0.65, 0.0], [0.4, 0.4, 0.38], 30.0, Material::Print([0.5, 0.3, 0.12], [0.2, 0.24, 0.34]));
}

fn corridor(b: &mut Builder) {
    b.block(
        [0.8, 5.05, 0.0],
        [8.4, 5.85, 0.01],
        Material::Carpet([0.14, 0.20, 0.14], [0.52, 0.40, 0.22], [0.36, 0.10, 0.09]),
    );
    // North wall: console table, bench, cabinet, pictures.
    b.block([3.0, 5.92, 0.70], [4.3, 6.2, 0.74], WALNUT);
    for x in [3.03, 4.22] {
        b.block([x, 5.95, 0.0], [x + 0.05, 6.18, 0.70], WALNUT);
    }
    b.block([3.05, 5.96, 0.22], [4.25, 6.18, 0.25], WALNUT);
    b.stack([3.3, 6.07, 0.25], 6);
    b.turned([3.9, 6.07, 0.25], [0.4, 0.2, 0.22], 4.0, Material::Print([0.5, 0.42, 0.3], [0.26, 0.2, 0.14]));
    b.vase([3.25, 6.07, 0.74], 0.08, 0.32);
    b.stack([3.65, 6.07, 0.74], 3);
    b.ball([4.05, 6.07, 0.83], 0.09, Material::Leaves([0.2, 0.36, 0.14]));
    b.picture([3.2, 6.17, 1.2], [4.1, 6.2, 2.0], PINE);
    b.picture([1.2, 6.17, 1.2], [1.9, 6.2, 1.9], WALNUT);
    b.picture([2.2, 6.17, 1.3], [2.7, 6.2, 2.0], WALNUT);
    b.picture([4.8, 6.17, 1.25], [5.6, 6.2, 1.9], WALNUT);
    b.block([5.9, 5.9, 0.05], [6.9, 6.2, 0.95], PINE);
    b.stack([6.2, 6.05, 0.95], 4);
    b.vase([6.65, 6.05, 0.95], 0.07, 0.26);
    b.picture([6.0, 6.17, 1.35], [6.8, 6.2, 2.05], PINE);
    b.picture([7.4, 6.17, 1.2], [8.2, 6.2, 2.0], WALNUT);
    b.block([1.0, 5.9, 0.0], [2.1, 6.2, 0.42], OAK);
    b.turned([1.4, 6.05, 0.42], [0.36, 0.24, 0.12], 8.0, Material::Print([0.2, 0.3, 0.4], [0.6, 0.55, 0.4]));
    // South wall: pictures and a coat rack with coats.
    b.picture([0.6, 4.7, 1.2], [1.3, 4.73, 2.0], PINE);
    b.picture([4.6, 4.7, 1.2], [5.3, 4.73, 1.9], WALNUT);
    b.picture([5.7, 4.7, 1.2], [6.6, 4.73, 2.0], PINE);
    b.block([1.7, 4.7, 1.7], [2.8, 4.74, 1.8], WALNUT);
    for (i, x) in [1.85f32, 2.2, 2.55].into_iter().enumerate() {
        let coat = Material::Fabric(palette(b.word(i as u32 + 60)));
        b.turned([x, 4.82, 0.75 + 0.1 * i as f32], [0.28, 0.14, 0.9], 5.0 * i as f32, coat);
    }
    // Ends.
    b.picture([0.0, 4.95, 1.1], [0.03, 5.9, 2.0], WALNUT);
    b.block([0.02, 5.1, 0.0], [0.4, 5.7, 0.8], OAK);
    b.vase([0.2, 5.4, 0.8], 0.09, 0.3);
    b.picture([9.17, 4.95, 1.1], [9.2, 5.9, 2.0], PINE);
    b.plant([8.85, 5.45, 0.0], 1.2);
}

/// All objects and light sources of the rooms. The seed changes textures, books and small things; walls,
/// furniture and doors stay where they are.
pub fn furnished_rooms(seed: u64) -> (Vec<Object>, Vec<LightSource>) {
    let mut b = Builder { objects: Vec::new(), seed: hash(seed as u32, (seed >> 32) as u32) };
    shell(&mut b);
    living_room(&mut b);
    study(&mut b);
    corridor(&mut b);
    let mut sources = Vec::new();
    for (x, y, power) in
        [(2.4, 2.2, 2.6), (7.2, 2.2, 2.4), (2.0, 5.45, 1.2), (5.0, 5.45, 1.2), (7.8, 5.45, 1.2)]
    {
        b.drum([x, y, HEIGHT_M - 0.08], 0.2, 0.07, Material::Lamp);
        sources.push(LightSource { centre: V3::new(x, y, HEIGHT_M - 0.35), radius: 0.25, power });
    }
    sources.push(LightSource { centre: V3::new(0.25, 3.7, 1.5), radius: 0.4, power: 1.3 });
    (b.objects, sources)
}

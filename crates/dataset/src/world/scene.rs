//! Solid objects, a bounding-volume hierarchy over them, and rays.

use super::material::Material;
use nalgebra::Vector3;

/// Metres in the world (z up), or a direction.
pub type V3 = Vector3<f32>;

/// A solid around its own origin.
#[derive(Clone, Copy, Debug)]
pub enum Shape {
    /// A box with these half sides.
    Block(V3),
    /// A sphere of this radius.
    Ball(f32),
    /// An upright cylinder: radius and half height.
    Drum(f32, f32),
}

/// A solid in the world, turned about the vertical.
#[derive(Clone, Debug)]
pub struct Object {
    /// Metres.
    pub centre: V3,
    /// Cosine and sine of the turn about z.
    pub turn: (f32, f32),
    /// Its form.
    pub shape: Shape,
    /// What it is made of.
    pub material: Material,
    /// Makes its texture differ from that of its siblings.
    pub seed: u32,
}

/// A point on an object's surface, in the terms that textures and light maps use.
#[derive(Clone, Copy, Debug)]
pub struct SurfacePoint {
    /// 0..6 for a block, 0..3 for a drum, 0 for a ball.
    pub face: u8,
    /// Metres from the face's centre, horizontal.
    pub a: f32,
    /// Metres from the face's centre; up where the face is vertical.
    pub b: f32,
    /// Half the face's size along `a` and `b`.
    pub half: (f32, f32),
    /// Unit normal in the object's own axes.
    pub normal: V3,
}

impl Object {
    /// A world vector in the object's own axes.
    #[inline]
    pub fn turned_in(&self, v: &V3) -> V3 {
        let (c, s) = self.turn;
        V3::new(c * v.x + s * v.y, -s * v.x + c * v.y, v.z)
    }

    /// A vector of the object's own axes in the world's.
    #[inline]
    pub fn turned_out(&self, v: &V3) -> V3 {
        let (c, s) = self.turn;
        V3::new(c * v.x - s * v.y, s * v.x + c * v.y, v.z)
    }

    /// Where a ray enters and leaves the solid, in multiples of `direction`.
    #[inline]
    fn span(&self, origin: &V3, direction: &V3) -> Option<(f32, f32)> {
        let o = self.turned_in(&(origin - self.centre));
        let d = self.turned_in(direction);
        let quadratic = |a: f32, b: f32, c: f32| {
            let root = b * b - a * c;
            if !(root > 0.0 && a > 0.0) {
                return None;
            }
            let root = root.sqrt();
            Some(((-b - root) / a, (-b + root) / a))
        };
        match self.shape {
            Shape::Block(half) => {
                let (mut near, mut far) = (f32::NEG_INFINITY, f32::INFINITY);
                for i in 0..3 {
                    let inverse = 1.0 / d[i];
                    let (t0, t1) = ((-half[i] - o[i]) * inverse, (half[i] - o[i]) * inverse);
                    near = near.max(t0.min(t1));
                    far = far.min(t0.max(t1));
                }
                (near < far).then_some((near, far))
            }
            Shape::Ball(radius) => quadratic(d.dot(&d), o.dot(&d), o.dot(&o) - radius * radius),
            Shape::Drum(radius, half_height) => {
                let (a, b, c) =
                    (d.x * d.x + d.y * d.y, o.x * d.x + o.y * d.y, o.x * o.x + o.y * o.y - radius * radius);
                let (mut near, mut far) = if a < 1e-12 {
                    if c > 0.0 {
                        return None;
                    }
                    (f32::NEG_INFINITY, f32::INFINITY)
                } else {
                    quadratic(a, b, c)?
                };
                let inverse = 1.0 / d.z;
                let (t0, t1) = ((-half_height - o.z) * inverse, (half_height - o.z) * inverse);
                near = near.max(t0.min(t1));
                far = far.min(t0.max(t1));
                (near < far).then_some((near, far))
            }
        }
    }

    /// Where a ray from outside enters, in multiples of `direction`.
    #[inline]
    pub fn entry(&self, origin: &V3, direction: &V3) -> Option<f32> {
        self.span(origin, direction).and_then(|(near, _)| (near > 1e-4).then_some(near))
    }

    /// Describes a world point that lies on the surface.
    #[inline]
    pub fn surface_point(&self, point: &V3) -> SurfacePoint {
        let p = self.turned_in(&(point - self.centre));
        match self.shape {
            Shape::Block(half) => {
                let mut axis = 0;
                let mut best = f32::NEG_INFINITY;
                for i in 0..3 {
                    // The face whose plane the point is nearest to.
                    let inside = p[i].abs() - half[i];
                    if inside > best {
                        (axis, best) = (i, inside);
                    }
                }
                let sign = if p[axis] > 0.0 { 1.0 } else { -1.0 };
                let mut normal = V3::zeros();
                normal[axis] = sign;
                let (i, j) = [(1, 2), (0, 2), (0, 1)][axis];
                let face = (axis * 2) as u8 + u8::from(sign > 0.0);
                SurfacePoint { face, a: p[i], b: p[j], half: (half[i], half[j]), normal }
            }
            Shape::Ball(radius) => {
                let normal = p / radius;
                let a = normal.y.atan2(normal.x) * radius;
                let b = normal.z.clamp(-1.0, 1.0).asin() * radius;
                let half = (std::f32::consts::PI * radius, std::f32::consts::FRAC_PI_2 * radius);
                SurfacePoint { face: 0, a, b, half, normal }
            }
            Shape::Drum(radius, half_height) => {
                let side = (p.x * p.x + p.y * p.y).sqrt();
                if p.z.abs() - half_height > side - radius {
                    let up = p.z > 0.0;
                    let normal = V3::new(0.0, 0.0, if up { 1.0 } else { -1.0 });
                    let face = 1 + u8::from(up);
                    return SurfacePoint { face, a: p.x, b: p.y, half: (radius, radius), normal };
                }
                let normal = V3::new(p.x / side, p.y / side, 0.0);
                let half = (std::f32::consts::PI * radius, half_height);
                SurfacePoint { face: 0, a: p.y.atan2(p.x) * radius, b: p.z, half, normal }
            }
        }
    }

    /// The face's world point and normal at `(a, b)`: the inverse of [`Object::surface_point`].
    pub fn point_on_face(&self, face: u8, a: f32, b: f32) -> (V3, V3) {
        let (p, normal) = match self.shape {
            Shape::Block(half) => {
                let axis = (face / 2) as usize;
                let sign = if face % 2 == 1 { 1.0 } else { -1.0 };
                let (i, j) = [(1, 2), (0, 2), (0, 1)][axis];
                let (mut p, mut normal) = (V3::zeros(), V3::zeros());
                p[axis] = sign * half[axis];
                normal[axis] = sign;
                p[i] = a;
                p[j] = b;
                (p, normal)
            }
            Shape::Ball(radius) => {
                let (azimuth, elevation) = (a / radius, b / radius);
                let normal = V3::new(
                    elevation.cos() * azimuth.cos(),
                    elevation.cos() * azimuth.sin(),
                    elevation.sin(),
                );
                (normal * radius, normal)
            }
            Shape::Drum(radius, half_height) => match face {
                0 => {
                    let normal = V3::new((a / radius).cos(), (a / radius).sin(), 0.0);
                    (normal * radius + V3::new(0.0, 0.0, b), normal)
                }
                _ => {
                    let sign = if face == 2 { 1.0 } else { -1.0 };
                    // Texels outside the disc fall on its rim.
                    let shrink = (radius * 0.98 / (a * a + b * b).sqrt().max(1e-6)).min(1.0);
                    (V3::new(a * shrink, b * shrink, sign * half_height), V3::new(0.0, 0.0, sign))
                }
            },
        };
        (self.centre + self.turned_out(&p), self.turned_out(&normal))
    }

    /// Half sizes of every face, in the order of [`SurfacePoint::face`].
    pub fn faces(&self) -> Vec<(f32, f32)> {
        match self.shape {
            Shape::Block(h) => {
                vec![(h.y, h.z), (h.y, h.z), (h.x, h.z), (h.x, h.z), (h.x, h.y), (h.x, h.y)]
            }
            Shape::Ball(r) => vec![(std::f32::consts::PI * r, std::f32::consts::FRAC_PI_2 * r)],
            Shape::Drum(r, h) => vec![(std::f32::consts::PI * r, h), (r, r), (r, r)],
        }
    }

    fn bounds(&self) -> (V3, V3) {
        let (c, s) = (self.turn.0.abs(), self.turn.1.abs());
        let half = match self.shape {
            Shape::Block(h) => V3::new(c * h.x + s * h.y, s * h.x + c * h.y, h.z),
            Shape::Ball(r) => V3::new(r, r, r),
            Shape::Drum(r, h) => V3::new(r, r, h),
        };
        (self.centre - half, self.centre + half)
    }
}

/// What a ray met first.
#[derive(Clone, Copy, Debug)]
pub struct Hit {
    /// Index of the object.
    pub object: u32,
    /// Distance in multiples of the ray's direction.
    pub t: f32,
}

#[derive(Clone, Copy, Debug)]
struct Node {
    low: V3,
    high: V3,
    /// First object (leaf) or right child (inner; the left child is the next node).
    first: u32,
    /// Number of objects; 0 for an inner node.
    count: u32,
}

/// Objects and the hierarchy that finds them.
#[derive(Clone, Debug)]
pub struct Scene {
    /// In the order of the hierarchy's leaves.
    pub objects: Vec<Object>,
    nodes: Vec<Node>,
}

const LEAF_OBJECTS: usize = 2;

impl Scene {
    /// Sorts objects into a hierarchy (median split along the longest side).
    pub fn new(mut objects: Vec<Object>) -> Self {
        let mut nodes = Vec::new();
        let count = objects.len();
        split(&mut objects, 0, count, &mut nodes);
        Scene { objects, nodes }
    }

    /// The first surface along a ray.
    pub fn trace(&self, origin: &V3, direction: &V3) -> Option<Hit> {
        let mut best: Option<Hit> = None;
        let mut limit = f32::INFINITY;
        self.walk(origin, direction, |index, t_limit| {
            if let Some(t) = self.objects[index].entry(origin, direction)
                && t < limit
            {
                limit = t;
                best = Some(Hit { object: index as u32, t });
                *t_limit = t;
            }
            false
        });
        best
    }

    /// The free part of a segment, 0..1: how far along `direction` (times `reach`) the nearest solid is;
    /// 0 inside a solid.
    pub fn free_share(&self, origin: &V3, direction: &V3, reach: f32) -> f32 {
        let mut free = reach;
        self.walk(origin, direction, |index, t_limit| {
            if let Some((near, far)) = self.objects[index].span(origin, direction)
                && far > 1e-4
                && near < free
            {
                free = near.max(0.0);
                *t_limit = free;
            }
            free <= 0.0
        });
        free / reach
    }

    /// Visits the objects whose boxes the ray meets before the limit that `visit` may lower; stops when
    /// `visit` says so.
    #[inline]
    fn walk(&self, origin: &V3, direction: &V3, mut visit: impl FnMut(usize, &mut f32) -> bool) {
        let inverse = V3::new(1.0 / direction.x, 1.0 / direction.y, 1.0 / direction.z);
        let mut limit = f32::INFINITY;
        let enter = |node: &Node| {
            let (mut near, mut far) = (0.0f32, f32::INFINITY);
            for i in 0..3 {
                let (t0, t1) =
                    ((node.low[i] - origin[i]) * inverse[i], (node.high[i] - origin[i]) * inverse[i]);
                near = near.max(t0.min(t1));
                far = far.min(t0.max(t1));
            }
            if near <= far { near } else { f32::INFINITY }
        };
        let mut stack = [(0u32, 0.0f32); 64];
        let mut depth = 1;
        stack[0] = (0, enter(&self.nodes[0]));
        while depth > 0 {
            depth -= 1;
            let (index, near) = stack[depth];
            if !(near < limit) {
                continue;
            }
            let node = &self.nodes[index as usize];
            if node.count > 0 {
                for object in node.first..node.first + node.count {
                    if visit(object as usize, &mut limit) {
                        return;
                    }
                }
                continue;
            }
            let (left, right) = (index + 1, node.first);
            let (tl, tr) = (enter(&self.nodes[left as usize]), enter(&self.nodes[right as usize]));
            let ordered = if tl <= tr { [(right, tr), (left, tl)] } else { [(left, tl), (right, tr)] };
            for entry in ordered {
                if entry.1 < limit {
                    stack[depth] = entry;
                    depth += 1;
                }
            }
        }
    }
}

fn split(objects: &mut [Object], first: usize, end: usize, nodes: &mut Vec<Node>) {
    let (mut low, mut high) = (V3::repeat(f32::INFINITY), V3::repeat(f32::NEG_INFINITY));
    let (mut centre_low, mut centre_high) = (low, high);
    for object in &objects[first..end] {
        let (l, h) = object.bounds();
        low = low.inf(&l);
        high = high.sup(&h);
        centre_low = centre_low.inf(&object.centre);
        centre_high = centre_high.sup(&object.centre);
    }
    let index = nodes.len();
    let count = end - first;
    if count <= LEAF_OBJECTS {
        nodes.push(Node { low, high, first: first as u32, count: count as u32 });
        return;
    }
    nodes.push(Node { low, high, first: 0, count: 0 });
    let axis = (centre_high - centre_low).imax();
    objects[first..end].sort_by(|x, y| x.centre[axis].total_cmp(&y.centre[axis]));
    let middle = first + count / 2;
    split(objects, first, middle, nodes);
    nodes[index].first = nodes.len() as u32;
    split(objects, middle, end, nodes);
}

//! The convex bodies everything is built of, in f32 relative to the scene's origin.

use glam::{Vec2, Vec3};

/// Kind of body, in its own frame (turned about z, centred at the shape's centre).
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Form {
    /// |x|, |y|, |z| <= half.
    Block,
    /// A block whose top face has half extents `top` and is moved by `shift` along x: cabins, roofs.
    Taper {
        /// Half extents of the top face.
        top: Vec2,
        /// Shift of the top face along x.
        shift: f32,
    },
    /// Upright cone or cylinder: radius `half.x` at the bottom, `top` at the top.
    Cone {
        /// Radius at the top.
        top: f32,
    },
    /// Ellipsoid with radii `half`.
    Ball,
    /// Cylinder along y: radius `half.x`, half width `half.y`.
    Wheel,
}

/// What a shape looks like and stands for.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Surface {
    /// Pattern.
    pub look: Look,
    /// Main colour, linear.
    pub color: Vec3,
    /// Second colour of the pattern, linear.
    pub accent: Vec3,
    /// Occ3D-nuScenes class.
    pub label: u8,
    /// 0, or actor id + 1.
    pub instance: u32,
    /// Makes equal patterns differ.
    pub salt: u32,
    /// Lamps of the body are switched on when it is dark.
    pub lit: bool,
}

/// Patterns that the shader knows.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Look {
    /// One colour with faint dirt.
    Plain,
    /// Walls with a grid of windows.
    Facade,
    /// Brick or plaster without windows.
    Wall,
    /// Tiles or gravel.
    Roof,
    /// Leaves.
    Foliage,
    /// Vehicle body: lamps at both ends, dark sill, door lines.
    CarBody,
    /// Window band with a painted top.
    CarCabin,
    /// Bus: windows on the upper half, lamps at both ends.
    BusBody,
    /// Cargo box: ribs, tail lamps at the rear.
    Cargo,
    /// Diagonal stripes of both colours.
    Warning,
    /// Horizontal bands of both colours.
    Bands,
    /// Shines by itself when lamps are lit; `accent` is the glow.
    Lamp,
}

/// A convex body.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Shape {
    /// Centre.
    pub center: Vec3,
    /// Cosine and sine of its heading.
    pub turn: Vec2,
    /// Half extents in its own frame.
    pub half: Vec3,
    /// Kind.
    pub form: Form,
}

impl Shape {
    /// A vector of the scene in the body's own axes.
    pub fn local_of(&self, v: Vec3) -> Vec3 {
        Vec3::new(self.turn.x * v.x + self.turn.y * v.y, self.turn.x * v.y - self.turn.y * v.x, v.z)
    }

    /// A vector of the body's own axes in the scene.
    pub fn scene_of(&self, v: Vec3) -> Vec3 {
        Vec3::new(self.turn.x * v.x - self.turn.y * v.y, self.turn.y * v.x + self.turn.x * v.y, v.z)
    }

    /// Axis-aligned bounds.
    pub fn bounds(&self) -> (Vec3, Vec3) {
        let mut h = self.half;
        match self.form {
            Form::Taper { top, shift } => {
                h.x = h.x.max(top.x + shift.abs());
                h.y = h.y.max(top.y);
            }
            Form::Cone { top } => {
                let r = h.x.max(top);
                let reach = Vec3::new(r, r, h.z);
                return (self.center - reach, self.center + reach);
            }
            Form::Wheel => h.z = h.x,
            Form::Block | Form::Ball => {}
        }
        let (c, s) = (self.turn.x.abs(), self.turn.y.abs());
        let reach = Vec3::new(c * h.x + s * h.y, s * h.x + c * h.y, h.z);
        (self.center - reach, self.center + reach)
    }

    /// Distance at which a ray enters the body, if it does so within (near, far). A ray that starts inside does not see it.
    #[inline]
    pub fn enter(&self, origin: Vec3, direction: Vec3, near: f32, far: f32) -> Option<f32> {
        let o = self.local_of(origin - self.center);
        let d = self.local_of(direction);
        let t = match self.form {
            Form::Block => {
                // A zero would make 0 * inf; a ray exactly along an axis is common: cars ahead in the own lane.
                let inv = Vec3::from_array(d.to_array().map(|v| 1.0 / if v.abs() < 1e-9 { 1e-9 } else { v }));
                let mid = -o * inv;
                let reach = self.half * inv.abs();
                let t0 = max3(mid - reach);
                let t1 = min3(mid + reach);
                if t0 > t1 {
                    return None;
                }
                t0
            }
            Form::Taper { top, shift } => enter_taper(o, d, self.half, top, shift)?,
            Form::Cone { top } => enter_cone(o, d, self.half.x, top, self.half.z)?,
            Form::Ball => {
                let inv = Vec3::ONE / self.half;
                enter_ball(o * inv, d * inv)?
            }
            Form::Wheel => {
                // The same cylinder with y and z exchanged.
                let swap = |v: Vec3| Vec3::new(v.x, v.z, v.y);
                enter_cone(swap(o), swap(d), self.half.x, self.half.x, self.half.y)?
            }
        };
        (t > near && t < far).then_some(t)
    }

    /// Outward normal in the body's own axes at a point on its surface (own axes).
    pub fn local_normal(&self, p: Vec3) -> Vec3 {
        match self.form {
            Form::Block => {
                let q = (p / self.half).abs();
                if q.x >= q.y && q.x >= q.z {
                    Vec3::new(p.x.signum(), 0.0, 0.0)
                } else if q.y >= q.z {
                    Vec3::new(0.0, p.y.signum(), 0.0)
                } else {
                    Vec3::new(0.0, 0.0, p.z.signum())
                }
            }
            Form::Taper { top, shift } => taper_planes(self.half, top, shift)
                .into_iter()
                .max_by(|a, b| (a.0.dot(p) - a.1).total_cmp(&(b.0.dot(p) - b.1)))
                .map_or(Vec3::Z, |plane| plane.0),
            Form::Cone { top } => cone_normal(p, self.half.x, top, self.half.z),
            Form::Ball => (p / (self.half * self.half)).normalize_or_zero(),
            Form::Wheel => {
                let n = cone_normal(Vec3::new(p.x, p.z, p.y), self.half.x, self.half.x, self.half.y);
                Vec3::new(n.x, n.z, n.y)
            }
        }
    }

    /// The point of the body nearest to (or, for balls and cones, radially below) a point in its own axes; itself if inside.
    pub fn local_nearest(&self, p: Vec3) -> Vec3 {
        match self.form {
            Form::Block => p.clamp(-self.half, self.half),
            Form::Taper { top, shift } => {
                let z = p.z.clamp(-self.half.z, self.half.z);
                let t = 0.5 + 0.5 * z / self.half.z;
                let half = self.half.truncate() + (top - self.half.truncate()) * t;
                let middle = shift * t;
                Vec3::new(middle + (p.x - middle).clamp(-half.x, half.x), p.y.clamp(-half.y, half.y), z)
            }
            Form::Cone { top } => cone_nearest(p, self.half.x, top, self.half.z),
            Form::Ball => {
                let r = (p / self.half).length();
                if r <= 1.0 { p } else { p / r }
            }
            Form::Wheel => {
                let n = cone_nearest(Vec3::new(p.x, p.z, p.y), self.half.x, self.half.x, self.half.y);
                Vec3::new(n.x, n.z, n.y)
            }
        }
    }
}

fn cone_nearest(p: Vec3, bottom: f32, top: f32, half_z: f32) -> Vec3 {
    let z = p.z.clamp(-half_z, half_z);
    let radius = bottom + (top - bottom) * (0.5 + 0.5 * z / half_z);
    let flat = p.truncate().clamp_length_max(radius.max(1e-4));
    flat.extend(z)
}

fn cone_normal(p: Vec3, bottom: f32, top: f32, half_z: f32) -> Vec3 {
    let slope = (top - bottom) / (2.0 * half_z);
    let radius = bottom + slope * (p.z + half_z);
    let flat = p.truncate();
    let rim = flat.length();
    if half_z - p.z.abs() < (radius - rim).abs() && rim < radius {
        return Vec3::new(0.0, 0.0, p.z.signum());
    }
    (flat / rim.max(1e-6)).extend(-slope).normalize()
}

fn max3(v: Vec3) -> f32 {
    let a = if v.x > v.y { v.x } else { v.y };
    if a > v.z { a } else { v.z }
}

fn min3(v: Vec3) -> f32 {
    let a = if v.x < v.y { v.x } else { v.y };
    if a < v.z { a } else { v.z }
}

/// The six planes n·p <= w of a taper.
fn taper_planes(half: Vec3, top: Vec2, shift: f32) -> [(Vec3, f32); 6] {
    let rise = 2.0 * half.z;
    let side = |axis: Vec2, bottom: f32, top: f32| {
        // Through `bottom` at z = -half.z and `top` at z = +half.z.
        let normal = axis.extend((bottom - top) / rise).normalize();
        (normal, normal.dot((axis * bottom).extend(-half.z)))
    };
    [
        side(Vec2::X, half.x, top.x + shift),
        side(-Vec2::X, half.x, top.x - shift),
        side(Vec2::Y, half.y, top.y),
        side(-Vec2::Y, half.y, top.y),
        (Vec3::Z, half.z),
        (-Vec3::Z, half.z),
    ]
}

fn enter_taper(o: Vec3, d: Vec3, half: Vec3, top: Vec2, shift: f32) -> Option<f32> {
    let rise = 0.5 / half.z;
    let (mut t0, mut t1) = (f32::NEG_INFINITY, f32::INFINITY);
    // Unnormalised planes (sign*x or y) + k z <= w give the same distances at half the cost.
    let mut clip = |n_o: f32, n_d: f32, w: f32| {
        let t = (w - n_o) / n_d;
        if n_d < 0.0 {
            t0 = if t > t0 { t } else { t0 };
        } else if n_d > 0.0 {
            t1 = if t < t1 { t } else { t1 };
        } else if n_o > w {
            t1 = f32::NEG_INFINITY;
        }
    };
    for (sign, target) in [(1.0, top.x + shift), (-1.0, top.x - shift)] {
        let k = (half.x - target) * rise;
        clip(sign * o.x + k * o.z, sign * d.x + k * d.z, half.x - k * half.z);
    }
    let k = (half.y - top.y) * rise;
    for sign in [1.0, -1.0] {
        clip(sign * o.y + k * o.z, sign * d.y + k * d.z, half.y - k * half.z);
        clip(sign * o.z, sign * d.z, half.z);
    }
    (t0 <= t1).then_some(t0)
}

fn enter_cone(o: Vec3, d: Vec3, bottom: f32, top: f32, half_z: f32) -> Option<f32> {
    let slope = (top - bottom) / (2.0 * half_z);
    let r0 = bottom + slope * (o.z + half_z);
    let rd = slope * d.z;
    let a = d.x * d.x + d.y * d.y - rd * rd;
    let b = o.x * d.x + o.y * d.y - r0 * rd;
    let c = o.x * o.x + o.y * o.y - r0 * r0;
    let mut best = f32::INFINITY;
    let disc = b * b - a * c;
    if disc > 0.0 && a.abs() > 1e-12 {
        let root = disc.sqrt();
        for t in [(-b - root) / a, (-b + root) / a] {
            // Only where the ray goes inward; the mirrored half of the cone has a negative radius.
            let inward = a * t + b < 0.0;
            if inward && (o.z + t * d.z).abs() <= half_z && r0 + t * rd > 0.0 && t < best {
                best = t;
            }
        }
    }
    if d.z.abs() > 1e-12 {
        // The cap that the ray can enter through.
        let (z, radius) = if d.z < 0.0 { (half_z, top) } else { (-half_z, bottom) };
        let t = (z - o.z) / d.z;
        let (x, y) = (o.x + t * d.x, o.y + t * d.y);
        if x * x + y * y <= radius * radius && t < best {
            best = t;
        }
    }
    (best < f32::INFINITY).then_some(best)
}

fn enter_ball(o: Vec3, d: Vec3) -> Option<f32> {
    let a = d.length_squared();
    let b = o.dot(d);
    // The squared distance of the line from the centre, without the cancellation of b² - a c.
    let off = o - d * (b / a);
    let gap = 1.0 - off.length_squared();
    (gap > 0.0).then(|| (-b - (gap * a).sqrt()) / a)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn shape(form: Form) -> Shape {
        Shape { center: Vec3::new(1.0, 2.0, 3.0), turn: Vec2::new(0.8, 0.6), half: Vec3::new(1.5, 0.7, 1.0), form }
    }

    /// Every entry point lies on the surface (nearest point is itself, a step outward leaves the body) and inside the bounds.
    #[test]
    fn entry_points_lie_on_the_surface() {
        let taper = Form::Taper { top: Vec2::new(0.5, 0.3), shift: -0.3 };
        for form in [Form::Block, taper, Form::Cone { top: 0.4 }, Form::Cone { top: 1.5 }, Form::Ball, Form::Wheel] {
            let body = shape(form);
            let (low, high) = body.bounds();
            let mut hits = 0;
            for i in 0..400 {
                let (a, b) = (i as f32 * 0.7, i as f32 * 0.31);
                let origin = body.center + Vec3::new(9.0 * a.cos(), 9.0 * a.sin(), 6.0 * b.sin());
                let aim = body.center + Vec3::new(0.8 * b.cos(), 0.6 * b.sin(), 0.7 * (a * 1.3).cos());
                let direction = (aim - origin).normalize();
                let Some(t) = body.enter(origin, direction, 0.0, 100.0) else { continue };
                hits += 1;
                let point = origin + direction * t;
                assert!(point.cmpge(low - 1e-3).all() && point.cmple(high + 1e-3).all(), "{form:?}");
                let local = body.local_of(point - body.center);
                assert!((body.local_nearest(local) - local).length() < 2e-3, "{form:?} {local}");
                let normal = body.local_normal(local);
                assert!((normal.length() - 1.0).abs() < 1e-3, "{form:?}");
                assert!(normal.dot(body.local_of(direction)) < 1e-3, "{form:?} {normal}");
                let outside = local + normal * 0.02;
                assert!((body.local_nearest(outside) - outside).length() > 1e-3, "{form:?} {local} {normal}");
            }
            assert!(hits > 200, "{form:?}: {hits}");
        }
    }

    #[test]
    fn rays_from_inside_and_beside_miss() {
        let body = shape(Form::Block);
        assert!(body.enter(body.center, Vec3::X, 0.0, 100.0).is_none());
        assert!(body.enter(body.center + Vec3::new(0.0, 0.0, 5.0), Vec3::X, 0.0, 100.0).is_none());
    }

    /// Regression: a ray exactly along an axis once met only the slabs that it was not parallel to.
    #[test]
    fn rays_along_an_axis_meet_the_face() {
        let body = Shape { center: Vec3::ZERO, turn: Vec2::X, half: Vec3::new(0.5, 0.2, 0.3), form: Form::Block };
        assert_eq!(body.enter(Vec3::new(-20.0, 0.0, 0.0), Vec3::X, 0.0, 100.0), Some(19.5));
        assert_eq!(body.enter(Vec3::new(-20.0, 0.25, 0.0), Vec3::X, 0.0, 100.0), None);
    }
}

//! Builds the shapes of actors. Own axes: x forward, y left, z up from the ground below the box centre; everything stays in the box.

use glam::{Vec2, Vec3};

use crate::actor::ActorClass;
use crate::fleet::rgb;
use crate::math::sin_cos;
use crate::script::Actor;
use crate::shape::{Form, Look, Shape, Surface};

/// Puts parts of one body into the scene.
pub struct Kit<'a> {
    /// Where shapes go.
    pub out: &'a mut Vec<(Shape, Surface)>,
    /// Foot of the body, relative to the scene's origin.
    pub foot: Vec3,
    /// Cosine and sine of its heading.
    pub turn: Vec2,
    /// Class of all parts.
    pub label: u8,
    /// Instance of all parts.
    pub instance: u32,
    /// Salt of all parts.
    pub salt: u32,
    /// Lamps on in the dark.
    pub lit: bool,
}

impl Kit<'_> {
    /// Adds a part with its centre and half extents in the body's axes.
    pub fn put(&mut self, form: Form, center: Vec3, half: Vec3, look: Look, color: Vec3, accent: Vec3) {
        let turned =
            Vec2::new(self.turn.x * center.x - self.turn.y * center.y, self.turn.y * center.x + self.turn.x * center.y);
        let shape = Shape { center: self.foot + turned.extend(center.z), turn: self.turn, half, form };
        let (label, instance, salt, lit) = (self.label, self.instance, self.salt, self.lit);
        let surface = Surface { look, color, accent, label, instance, salt, lit };
        self.out.push((shape, surface));
    }

    fn plain(&mut self, form: Form, center: Vec3, half: Vec3, color: Vec3) {
        self.put(form, center, half, Look::Plain, color, color);
    }
}

/// The parts of an actor at a place of the scene; `travelled` drives legs.
pub fn build(actor: &Actor, foot: Vec3, yaw: f64, travelled: f64, out: &mut Vec<(Shape, Surface)>) {
    let (sin, cos) = sin_cos(yaw);
    let mut kit = Kit {
        out,
        foot,
        turn: Vec2::new(cos as f32, sin as f32),
        label: actor.class.semantic(),
        instance: actor.id + 1,
        salt: actor.style.salt,
        lit: !actor.parked,
    };
    let size = actor.size.as_vec3();
    let (color, accent) = (actor.style.color, actor.style.accent);
    let gait = sin_cos(travelled * 4.2).0 as f32;
    match (actor.class, actor.style.variant) {
        (ActorClass::Car, variant) => car(&mut kit, size, variant, color),
        (ActorClass::Truck, 0) => pickup(&mut kit, size, color),
        (ActorClass::Truck, _) => truck(&mut kit, size, color, accent),
        (ActorClass::Bus, _) => bus(&mut kit, size, color, accent),
        (ActorClass::Trailer, _) => trailer(&mut kit, size, color),
        (ActorClass::ConstructionVehicle, _) => excavator(&mut kit, size, color, accent),
        (ActorClass::Motorcycle, _) => motorcycle(&mut kit, size, color, accent, actor.with_rider),
        (ActorClass::Bicycle, _) => bicycle(&mut kit, size, color, accent, actor.with_rider, gait),
        (ActorClass::Pedestrian, _) => pedestrian(&mut kit, size, color, accent, gait),
        (ActorClass::TrafficCone, _) => {
            kit.put(Form::Block, Vec3::new(0.0, 0.0, 0.03), Vec3::new(0.2, 0.2, 0.03), Look::Plain, color * 0.5, color);
            let half = Vec3::new(0.15, 0.15, (size.z - 0.06) * 0.5);
            kit.put(Form::Cone { top: 0.03 }, Vec3::Z * (0.06 + half.z), half, Look::Bands, color, accent);
        }
        (ActorClass::Barrier, _) => barrier(&mut kit, size, color, accent),
    }
}

fn dark() -> Vec3 {
    rgb(24, 24, 27)
}

fn glass() -> Vec3 {
    rgb(42, 52, 62)
}

fn skin(salt: u32) -> Vec3 {
    [rgb(232, 190, 160), rgb(190, 140, 105), rgb(120, 80, 58), rgb(90, 60, 45)][(salt % 4) as usize]
}

fn wheels(kit: &mut Kit, radius: f32, xs: &[f32], y: f32, width: f32) {
    for x in xs {
        for side in [-1.0, 1.0] {
            let center = Vec3::new(*x, side * (y - width), radius);
            kit.plain(Form::Wheel, center, Vec3::new(radius, width, radius), dark());
        }
    }
}

fn car(kit: &mut Kit, size: Vec3, variant: u8, color: Vec3) {
    let (l, w, h) = (size.x, size.y, size.z);
    // Height of the belt line; cabin length at the bottom and top, and how far its middle and its top lie behind.
    let (belt, bottom, top, back, shift) = match variant {
        0 => (0.62, 0.29, 0.16, -0.06, -0.01),
        1 => (0.60, 0.34, 0.23, -0.12, -0.02),
        2 => (0.58, 0.36, 0.28, -0.10, -0.01),
        _ => (0.52, 0.44, 0.36, -0.05, -0.05),
    };
    let floor = 0.22;
    let rise = (belt * h - floor) * 0.5;
    let body = Form::Taper { top: Vec2::new(l * 0.5 - 0.10, w * 0.5 - 0.08), shift: 0.0 };
    kit.put(body, Vec3::Z * (floor + rise), Vec3::new(l * 0.5, w * 0.5, rise), Look::CarBody, color, glass());
    let cabin_half = (1.0 - belt) * h * 0.5;
    let cabin = Form::Taper { top: Vec2::new(l * top, w * 0.5 - 0.22), shift: l * shift };
    let center = Vec3::new(l * back, 0.0, h - cabin_half);
    kit.put(cabin, center, Vec3::new(l * bottom, w * 0.5 - 0.09, cabin_half), Look::CarCabin, color, glass());
    wheels(kit, 0.33, &[l * 0.31, -l * 0.31], w * 0.5, 0.11);
}

fn pickup(kit: &mut Kit, size: Vec3, color: Vec3) {
    let (l, w, h) = (size.x, size.y, size.z);
    let body = Form::Taper { top: Vec2::new(l * 0.5 - 0.06, w * 0.5 - 0.05), shift: 0.0 };
    let rise = (0.6 * h - 0.3) * 0.5;
    kit.put(body, Vec3::Z * (0.3 + rise), Vec3::new(l * 0.5, w * 0.5, rise), Look::CarBody, color, glass());
    let cabin = Form::Taper { top: Vec2::new(l * 0.12, w * 0.5 - 0.2), shift: -0.05 };
    kit.put(
        cabin,
        Vec3::new(l * 0.08, 0.0, 0.8 * h),
        Vec3::new(l * 0.19, w * 0.5 - 0.08, 0.2 * h),
        Look::CarCabin,
        color,
        glass(),
    );
    wheels(kit, 0.38, &[l * 0.32, -l * 0.32], w * 0.5, 0.13);
}

fn truck(kit: &mut Kit, size: Vec3, color: Vec3, accent: Vec3) {
    let (l, w, h) = (size.x, size.y, size.z);
    let cab = 1.9;
    let cab_top = h * 0.76;
    let front = l * 0.5 - cab * 0.5;
    kit.put(
        Form::Block,
        Vec3::new(front, 0.0, 0.45 + 0.35),
        Vec3::new(cab * 0.5, w * 0.48, 0.35),
        Look::CarBody,
        color,
        glass(),
    );
    let form = Form::Taper { top: Vec2::new(cab * 0.4, w * 0.44), shift: -0.12 };
    let half = (cab_top - 1.15) * 0.5;
    kit.put(
        form,
        Vec3::new(front, 0.0, 1.15 + half),
        Vec3::new(cab * 0.5 - 0.02, w * 0.47, half),
        Look::CarCabin,
        color,
        glass(),
    );
    let cargo = (l - cab - 0.15) * 0.5;
    let rise = (h - 0.8) * 0.5;
    let center = Vec3::new(-l * 0.5 + cargo, 0.0, 0.8 + rise);
    kit.put(Form::Block, center, Vec3::new(cargo, w * 0.5, rise), Look::Cargo, accent * 0.5 + 0.4, accent);
    kit.plain(Form::Block, Vec3::new(0.0, 0.0, 0.62), Vec3::new(l * 0.46, w * 0.3, 0.2), dark());
    wheels(kit, 0.44, &[l * 0.36, -l * 0.3], w * 0.5, 0.16);
}

fn bus(kit: &mut Kit, size: Vec3, color: Vec3, accent: Vec3) {
    let (l, w, h) = (size.x, size.y, size.z);
    let rise = (h - 0.35) * 0.5;
    kit.put(
        Form::Block,
        Vec3::Z * (0.35 + rise),
        Vec3::new(l * 0.5, w * 0.5, rise),
        Look::BusBody,
        color.max(accent * 0.6),
        glass(),
    );
    wheels(kit, 0.46, &[l * 0.31, -l * 0.26], w * 0.5, 0.14);
}

fn trailer(kit: &mut Kit, size: Vec3, color: Vec3) {
    let (l, w, h) = (size.x, size.y, size.z);
    let rise = (h - 0.85) * 0.5;
    kit.put(
        Form::Block,
        Vec3::Z * (0.85 + rise),
        Vec3::new(l * 0.5, w * 0.5, rise),
        Look::Cargo,
        color * 0.6 + 0.25,
        color,
    );
    kit.plain(Form::Block, Vec3::Z * 0.65, Vec3::new(l * 0.47, w * 0.3, 0.2), dark());
    wheels(kit, 0.42, &[-l * 0.22, -l * 0.36], w * 0.5, 0.15);
    kit.plain(Form::Block, Vec3::new(l * 0.36, 0.0, 0.3), Vec3::new(0.12, w * 0.3, 0.3), dark());
}

fn excavator(kit: &mut Kit, size: Vec3, color: Vec3, accent: Vec3) {
    let (l, w, h) = (size.x, size.y, size.z);
    for side in [-1.0, 1.0] {
        let track = Vec3::new(-0.8, side * (w * 0.5 - 0.25), 0.4);
        kit.plain(Form::Block, track, Vec3::new(1.7, 0.25, 0.4), accent * 0.6);
    }
    kit.put(
        Form::Block,
        Vec3::new(-0.9, 0.0, 1.35),
        Vec3::new(l * 0.5 - 0.9, w * 0.45, 0.6),
        Look::Warning,
        color,
        color * 0.85,
    );
    let cab = Form::Taper { top: Vec2::new(0.5, 0.45), shift: 0.0 };
    kit.put(
        cab,
        Vec3::new(-0.2, w * 0.5 - 0.62, h - 0.65),
        Vec3::new(0.65, 0.52, 0.65),
        Look::CarCabin,
        color,
        glass(),
    );
    // Boom toward the front, arm down, bucket on the ground.
    kit.plain(Form::Block, Vec3::new(1.6, 0.0, 1.75), Vec3::new(1.2, 0.16, 0.3), color);
    kit.plain(Form::Block, Vec3::new(2.6, 0.0, 1.3), Vec3::new(0.2, 0.15, 0.75), color * 0.9);
    kit.plain(Form::Block, Vec3::new(2.6, 0.0, 0.35), Vec3::new(0.45, 0.4, 0.3), accent);
}

fn rider(kit: &mut Kit, seat: Vec3, top: f32, color: Vec3, accent: Vec3) {
    let torso = (top - 0.22 - seat.z) * 0.5;
    let lean = Form::Taper { top: Vec2::new(0.13, 0.19), shift: 0.16 };
    kit.plain(lean, seat + Vec3::Z * torso, Vec3::new(0.14, 0.16, torso), color);
    kit.plain(Form::Ball, Vec3::new(seat.x + 0.2, 0.0, top - 0.13), Vec3::new(0.13, 0.11, 0.13), accent);
}

fn motorcycle(kit: &mut Kit, size: Vec3, color: Vec3, accent: Vec3, with_rider: bool) {
    for x in [0.72, -0.72] {
        kit.plain(Form::Wheel, Vec3::new(x, 0.0, 0.32), Vec3::new(0.32, 0.08, 0.32), dark());
    }
    kit.put(
        Form::Ball,
        Vec3::new(0.05, 0.0, 0.66),
        Vec3::new(0.78, 0.2, 0.3),
        Look::CarBody,
        accent.max(color * 0.5),
        glass(),
    );
    kit.plain(Form::Block, Vec3::new(0.55, 0.0, 1.02), Vec3::new(0.05, 0.38, 0.05), dark());
    kit.plain(Form::Block, Vec3::new(0.62, 0.0, 0.7), Vec3::new(0.06, 0.07, 0.3), rgb(160, 160, 165));
    if with_rider {
        rider(kit, Vec3::new(-0.3, 0.0, 0.78), size.z, color, accent * 0.7);
        for side in [-1.0, 1.0] {
            kit.plain(Form::Block, Vec3::new(-0.05, side * 0.2, 0.62), Vec3::new(0.26, 0.07, 0.22), rgb(40, 45, 60));
            kit.plain(Form::Block, Vec3::new(0.22, side * 0.24, 1.1), Vec3::new(0.3, 0.05, 0.06), color);
        }
    }
}

fn bicycle(kit: &mut Kit, size: Vec3, color: Vec3, accent: Vec3, with_rider: bool, gait: f32) {
    for x in [0.53, -0.53] {
        kit.plain(Form::Wheel, Vec3::new(x, 0.0, 0.34), Vec3::new(0.34, 0.025, 0.34), dark());
    }
    kit.plain(Form::Block, Vec3::new(0.0, 0.0, 0.69), Vec3::new(0.45, 0.03, 0.27), accent);
    kit.plain(Form::Block, Vec3::new(0.46, 0.0, 1.0), Vec3::new(0.03, 0.27, 0.03), dark());
    if with_rider {
        rider(kit, Vec3::new(-0.22, 0.0, 0.88), size.z, color, skin(kit.salt));
        for side in [-1.0, 1.0] {
            let step = side * gait * 0.1;
            kit.plain(
                Form::Taper { top: Vec2::new(0.09, 0.08), shift: -0.12 },
                Vec3::new(0.0, side * 0.12, 0.62 + step),
                Vec3::new(0.08, 0.06, 0.32),
                rgb(45, 50, 70),
            );
            kit.plain(Form::Block, Vec3::new(0.22, side * 0.2, 1.16), Vec3::new(0.26, 0.04, 0.05), color);
        }
    }
}

fn pedestrian(kit: &mut Kit, size: Vec3, color: Vec3, accent: Vec3, gait: f32) {
    let h = size.z;
    let hip = h * 0.5;
    for side in [-1.0, 1.0] {
        let swing = side * gait * 0.17;
        // Legs reach from the hip to the foot: a taper whose top stays under the body.
        let leg = Form::Taper { top: Vec2::new(0.09, 0.085), shift: -swing };
        kit.plain(leg, Vec3::new(swing, side * 0.1, hip * 0.5), Vec3::new(0.075, 0.07, hip * 0.5), accent * 0.5);
        let arm = Form::Taper { top: Vec2::new(0.05, 0.05), shift: swing };
        let center = Vec3::new(-swing, side * 0.26, h * 0.62);
        kit.plain(arm, center, Vec3::new(0.05, 0.045, h * 0.17), color * 0.85);
    }
    let torso = Form::Taper { top: Vec2::new(0.12, 0.21), shift: 0.0 };
    kit.plain(torso, Vec3::Z * (h * 0.645), Vec3::new(0.14, 0.18, h * 0.185), color);
    kit.plain(Form::Ball, Vec3::Z * (h - 0.135), Vec3::new(0.11, 0.1, 0.135), skin(kit.salt));
}

fn barrier(kit: &mut Kit, size: Vec3, color: Vec3, accent: Vec3) {
    let w = size.y;
    kit.put(Form::Block, Vec3::Z * 0.62, Vec3::new(0.06, w * 0.5, 0.4), Look::Warning, color, accent);
    for side in [-1.0, 1.0] {
        let foot = Vec3::new(0.0, side * (w * 0.5 - 0.2), 0.14);
        kit.plain(Form::Block, foot, Vec3::new(0.25, 0.06, 0.14), rgb(70, 70, 70));
    }
}

//! Sizes and colours of actors.

use glam::{DVec3, Vec3};

use crate::actor::ActorClass;
use crate::dice::Dice;
use crate::script::Style;

/// A kind of actor with its measures, before it has a place.
#[derive(Debug, Clone, Copy)]
pub struct Model {
    /// Kind.
    pub class: ActorClass,
    /// Length, width, height.
    pub size: DVec3,
    /// Looks.
    pub style: Style,
    /// Rider.
    pub with_rider: bool,
}

/// sRGB-like 0..255 to linear.
pub fn rgb(r: u8, g: u8, b: u8) -> Vec3 {
    let v = Vec3::new(f32::from(r), f32::from(g), f32::from(b)) / 255.0;
    v * v
}

const PAINTS: [[u8; 3]; 16] = [
    [235, 235, 232],
    [225, 226, 228],
    [40, 41, 44],
    [28, 30, 36],
    [150, 153, 158],
    [110, 114, 120],
    [178, 180, 178],
    [165, 28, 30],
    [200, 40, 35],
    [28, 60, 130],
    [45, 100, 175],
    [30, 85, 60],
    [215, 170, 30],
    [205, 100, 30],
    [120, 90, 65],
    [95, 30, 60],
];

const CLOTHES: [[u8; 3]; 10] = [
    [40, 42, 50],
    [60, 70, 100],
    [150, 40, 40],
    [220, 215, 200],
    [50, 90, 60],
    [200, 150, 50],
    [110, 60, 110],
    [30, 100, 140],
    [130, 120, 110],
    [230, 120, 140],
];

fn paint(dice: &mut Dice, from: &[[u8; 3]]) -> Vec3 {
    let [r, g, b] = dice.pick(from);
    rgb(r, g, b) * dice.range_f32(0.8, 1.2)
}

impl Model {
    /// A model of a class; two-wheelers with or without a rider.
    pub fn draw(dice: &mut Dice, class: ActorClass, with_rider: bool) -> Self {
        let (variant, size): (u8, [f64; 3]) = match class {
            ActorClass::Car => dice.pick(&[
                (0, [4.6, 1.8, 1.45]),
                (0, [4.8, 1.85, 1.42]),
                (1, [4.0, 1.74, 1.52]),
                (2, [4.7, 1.92, 1.75]),
                (3, [5.0, 1.95, 2.05]),
            ]),
            ActorClass::Truck => dice.pick(&[(0, [5.3, 1.95, 1.85]), (1, [7.6, 2.4, 3.2]), (1, [6.6, 2.3, 2.9])]),
            ActorClass::Bus => (0, [11.2, 2.55, 3.1]),
            ActorClass::Trailer => (0, [dice.range(6.0, 8.0), 2.4, 3.1]),
            ActorClass::ConstructionVehicle => (0, [6.2, 2.3, 3.0]),
            ActorClass::Motorcycle => (0, [2.1, 0.8, if with_rider { 1.62 } else { 1.15 }]),
            ActorClass::Bicycle => (0, [1.75, 0.6, if with_rider { 1.72 } else { 1.08 }]),
            ActorClass::Pedestrian => (0, [0.72, 0.66, dice.range(1.5, 1.92)]),
            ActorClass::TrafficCone => (0, [0.4, 0.4, 0.78]),
            ActorClass::Barrier => (0, [0.5, 2.0, 1.05]),
        };
        let scale = match class {
            ActorClass::Car | ActorClass::Truck => dice.range(0.96, 1.04),
            _ => 1.0,
        };
        let (color, accent) = match class {
            ActorClass::Pedestrian | ActorClass::Bicycle | ActorClass::Motorcycle => {
                (paint(dice, &CLOTHES), paint(dice, &CLOTHES))
            }
            ActorClass::ConstructionVehicle => (rgb(225, 165, 20), rgb(50, 50, 50)),
            ActorClass::TrafficCone => (rgb(240, 90, 20), rgb(240, 240, 240)),
            ActorClass::Barrier => dice.pick(&[
                (rgb(225, 60, 40), rgb(240, 240, 240)),
                (rgb(240, 120, 20), rgb(240, 240, 240)),
                (rgb(230, 190, 30), rgb(40, 40, 40)),
            ]),
            _ => (paint(dice, &PAINTS), paint(dice, &PAINTS)),
        };
        let style = Style { variant, color, accent, salt: dice.bits() };
        let with_rider = with_rider && matches!(class, ActorClass::Motorcycle | ActorClass::Bicycle);
        Self { class, size: DVec3::from_array(size) * scale, style, with_rider }
    }
}

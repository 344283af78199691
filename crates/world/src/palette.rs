//! Colours of one scene, linear, drawn anew for every seed so that scenes differ strongly.

use glam::Vec3;

use crate::dice::Dice;
use crate::fleet::rgb;

/// Colours of ground, plants and buildings.
#[derive(Debug, Clone)]
pub struct Palette {
    /// Road surface.
    pub asphalt: Vec3,
    /// Car park surface.
    pub carpark: Vec3,
    /// Slabs of the sidewalk.
    pub sidewalk: Vec3,
    /// Paved ground beside sidewalks.
    pub paved: Vec3,
    /// Lawn.
    pub grass: Vec3,
    /// Bare ground.
    pub soil: Vec3,
    /// Kerb stones.
    pub kerb: Vec3,
    /// Leaves.
    pub leaves: [Vec3; 3],
    /// Walls.
    pub walls: Vec<Vec3>,
    /// Roofs.
    pub roofs: [Vec3; 2],
    /// Lamp posts and poles.
    pub metal: Vec3,
    /// Light of street lamps.
    pub lamp: Vec3,
    /// Shares of blocks beside the road that are paved and that are soil.
    pub blocks: [f32; 2],
}

const THEMES: [[[u8; 3]; 5]; 6] = [
    [[150, 75, 58], [170, 95, 70], [125, 62, 52], [190, 160, 135], [205, 190, 170]],
    [[214, 205, 190], [225, 215, 180], [200, 180, 150], [235, 230, 220], [180, 150, 120]],
    [[150, 152, 155], [120, 124, 130], [185, 188, 190], [95, 100, 108], [205, 205, 200]],
    [[225, 180, 150], [170, 200, 205], [235, 215, 150], [200, 160, 175], [165, 195, 165]],
    [[90, 110, 130], [120, 145, 160], [70, 85, 105], [170, 180, 185], [60, 66, 74]],
    [[196, 120, 60], [210, 165, 80], [160, 90, 60], [230, 205, 150], [120, 80, 65]],
];

/// Walls that occur beside every theme.
const COMMON_WALLS: [[u8; 3]; 6] =
    [[150, 75, 58], [214, 205, 190], [150, 152, 155], [165, 195, 165], [90, 110, 130], [210, 165, 80]];

impl Palette {
    /// Draws the colours of a scene.
    pub fn draw(dice: &mut Dice) -> Self {
        let tone = dice.range_f32(0.75, 1.35);
        let asphalt = Vec3::new(0.088, 0.088, 0.092)
            * tone
            * Vec3::new(1.0, dice.range_f32(0.94, 1.02), dice.range_f32(0.88, 1.08));
        let autumn = dice.chance(0.25);
        let dry = dice.range_f32(0.0, 1.0);
        let grass = rgb(92, 128, 56).lerp(rgb(158, 150, 92), dry * 0.8) * dice.range_f32(0.7, 1.1);
        let mut leaf = |salt: f32| {
            let green = rgb(62, 100, 42).lerp(rgb(104, 128, 52), salt) * dice.range_f32(0.7, 1.2);
            if autumn { green.lerp(rgb(190, 112, 36), dice.range_f32(0.3, 0.95)) } else { green }
        };
        let leaves = [leaf(0.1), leaf(0.5), leaf(0.9)];
        let theme = dice.pick(&THEMES);
        let walls = (0..10).map(|_| {
            let [r, g, b] = if dice.chance(0.8) { dice.pick(&theme) } else { dice.pick(&COMMON_WALLS) };
            rgb(r, g, b) * dice.range_f32(0.7, 1.15)
        });
        let walls = walls.collect();
        Self {
            asphalt,
            carpark: asphalt * dice.range_f32(0.85, 1.5),
            sidewalk: rgb(168, 163, 154).lerp(rgb(150, 110, 95), dice.range_f32(0.0, 0.6)) * dice.range_f32(0.7, 1.1),
            paved: rgb(140, 136, 128).lerp(rgb(150, 128, 110), dice.range_f32(0.0, 1.0)) * dice.range_f32(0.6, 1.1),
            grass,
            soil: rgb(140, 118, 92) * dice.range_f32(0.7, 1.2),
            kerb: rgb(182, 180, 174) * dice.range_f32(0.8, 1.1),
            leaves,
            walls,
            roofs: [
                rgb(135, 70, 52).lerp(rgb(80, 78, 80), dice.range_f32(0.0, 1.0)),
                rgb(96, 98, 102) * dice.range_f32(0.7, 1.3),
            ],
            metal: rgb(92, 96, 100) * dice.range_f32(0.6, 1.3),
            lamp: Vec3::new(1.0, 0.72, 0.42).lerp(Vec3::new(0.85, 0.92, 1.0), dice.range_f32(0.0, 0.8)),
            blocks: dice.pick(&[[0.15, 0.1], [0.5, 0.1], [0.3, 0.3], [0.7, 0.05]]),
        }
    }
}

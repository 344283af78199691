//! Calibrations of real vehicles, for worlds and tests that have no dataset at hand. A dataset's own files always win: real
//! rigs differ from log to log.
//!
//! Focal lengths and principal points are written as the source files hold them; files in OpenCV's convention (integer pixel
//! centres) get +0.5 on cx and cy here, like in their readers.

use glam::{DMat3, DQuat, DVec3};
use serde::{Deserialize, Serialize};

use crate::{CameraRig, Intrinsics, Lens, RigCamera, Rigid};

/// A vehicle whose calibration is built in.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub enum RigPreset {
    /// nuScenes n015 (scene-0061): six rectified cameras, closed ring.
    #[serde(rename = "nuscenes")]
    NuScenes,
    /// Argoverse 2 log 7fab2350: seven rectified ring cameras, the front one portrait; closed ring.
    #[serde(rename = "argoverse2")]
    Argoverse2,
    /// nuPlan: eight cameras with Brown–Conrady lenses, closed ring.
    #[serde(rename = "nuplan")]
    NuPlan,
    /// WayveScenes101: five fisheye cameras, closed ring. Only the distances between the cameras are published; poses and lens
    /// numbers are invented, those of the made scene 901 of the project's test data. Ego origin at its rear axle.
    #[serde(rename = "wayve_scenes101")]
    WayveScenes101,
    /// Waymo perception segment 1024360143612057520: five cameras with Brown–Conrady lenses and no view to the rear; open chain.
    #[serde(rename = "waymo")]
    Waymo,
}

impl RigPreset {
    /// Every preset.
    pub const ALL: [Self; 5] = [Self::NuScenes, Self::Argoverse2, Self::NuPlan, Self::WayveScenes101, Self::Waymo];

    /// The name that configs use.
    pub fn name(self) -> &'static str {
        match self {
            Self::NuScenes => "nuscenes",
            Self::Argoverse2 => "argoverse2",
            Self::NuPlan => "nuplan",
            Self::WayveScenes101 => "wayve_scenes101",
            Self::Waymo => "waymo",
        }
    }

    /// The cameras in rig order: clockwise from the front, Waymo's open chain from left to right.
    pub fn rig(self) -> CameraRig {
        let cameras = match self {
            Self::NuScenes => nuscenes_cameras(),
            Self::Argoverse2 => argoverse2_cameras(),
            Self::NuPlan => nuplan_cameras(),
            Self::WayveScenes101 => wayve_cameras(),
            Self::Waymo => waymo_cameras(),
        };
        CameraRig { cameras }
    }
}

/// Intrinsics of a file in OpenCV's convention with one focal length: `[f, cx, cy]`.
fn opencv_intrinsics([f, cx, cy]: [f64; 3], [width, height]: [u32; 2]) -> Intrinsics {
    Intrinsics { fx: f, fy: f, cx: cx + 0.5, cy: cy + 0.5, width, height }
}

fn pose_from_wxyz([w, x, y, z]: [f64; 4], translation: [f64; 3]) -> Rigid {
    Rigid::new(DQuat::from_xyzw(x, y, z, w), DVec3::from_array(translation))
}

fn pose_from_matrix(rotation: DMat3, translation: [f64; 3]) -> Rigid {
    Rigid::new(DQuat::from_mat3(&rotation), DVec3::from_array(translation))
}

fn rectified(channel: &str, size: [u32; 2], t: [f64; 3], wxyz: [f64; 4], f_cx_cy: [f64; 3]) -> RigCamera {
    RigCamera {
        channel: channel.to_owned(),
        intrinsics: opencv_intrinsics(f_cx_cy, size),
        lens: Lens::Pinhole,
        ego_from_cam: pose_from_wxyz(wxyz, t),
    }
}

#[rustfmt::skip] // a table: one camera per line
fn nuscenes_cameras() -> Vec<RigCamera> {
    let camera = |name, t, wxyz, f_cx_cy| rectified(name, [1600, 900], t, wxyz, f_cx_cy);
    vec![
        camera("CAM_FRONT", [1.70079, 0.01595, 1.51096], [0.499802, -0.503032, 0.499780, -0.497371], [1266.4172, 816.2670, 491.5071]),
        camera("CAM_FRONT_RIGHT", [1.55085, -0.49340, 1.49575], [0.206035, -0.202694, 0.682451, -0.671361], [1260.8474, 807.9682, 495.3344]),
        camera("CAM_BACK_RIGHT", [1.01488, -0.48057, 1.56240], [0.122810, -0.132401, -0.700431, 0.690496], [1259.5137, 807.2529, 501.1958]),
        camera("CAM_BACK", [0.02833, 0.00345, 1.57910], [0.503787, -0.497402, -0.494185, 0.504550], [809.2210, 829.2196, 481.7784]),
        camera("CAM_BACK_LEFT", [1.03569, 0.48480, 1.59097], [0.692419, -0.703162, -0.116483, 0.112033], [1256.7415, 792.1126, 492.7758]),
        camera("CAM_FRONT_LEFT", [1.52388, 0.49463, 1.50933], [0.675727, -0.673627, 0.212140, -0.211228], [1272.5979, 826.6155, 479.7517]),
    ]
}

#[rustfmt::skip] // a table: one camera per line
fn argoverse2_cameras() -> Vec<RigCamera> {
    let (portrait, landscape) = ([1550, 2048], [2048, 1550]);
    vec![
        rectified("ring_front_center", portrait, [1.63502, 0.00268, 1.39797], [0.501645, -0.498620, 0.501070, -0.498657], [1776.0415, 777.9906, 1013.5243]),
        rectified("ring_front_right", landscape, [1.55126, -0.19923, 1.39792], [0.264029, -0.277286, 0.670261, -0.635729], [1685.8841, 1028.0068, 766.1582]),
        rectified("ring_side_right", landscape, [1.30550, -0.27880, 1.39599], [-0.056086, 0.053602, 0.723359, -0.686100], [1686.7638, 1028.9586, 764.8483]),
        rectified("ring_rear_right", landscape, [1.10052, -0.12717, 1.41501], [-0.368356, 0.368223, 0.603709, -0.603541], [1689.2448, 1027.0118, 770.8191]),
        rectified("ring_rear_left", landscape, [1.09019, 0.12611, 1.41872], [0.601889, -0.603460, -0.369956, 0.369727], [1683.9427, 1029.0437, 765.7693]),
        rectified("ring_side_left", landscape, [1.30555, 0.27568, 1.40745], [0.687734, -0.721480, -0.059285, 0.054543], [1688.1950, 1027.7157, 765.5452]),
        rectified("ring_front_left", landscape, [1.54578, 0.20370, 1.39425], [0.637044, -0.668888, 0.276862, -0.264784], [1687.5278, 1031.4437, 768.2538]),
    ]
}

/// All nuPlan cameras share one set of lens numbers. `rows` of the rotation `ego_from_cam`.
fn nuplan(channel: &str, t: [f64; 3], rows: [[f64; 3]; 3]) -> RigCamera {
    RigCamera {
        channel: channel.to_owned(),
        intrinsics: opencv_intrinsics([1545.0, 960.0, 560.0], [1920, 1080]),
        lens: Lens::BrownConrady { k: [-0.356123, 0.172545, -0.05231], p: [-0.00213, 0.000464] },
        ego_from_cam: pose_from_matrix(DMat3::from_cols_array_2d(&rows).transpose(), t),
    }
}

#[rustfmt::skip] // a table: one camera per line
fn nuplan_cameras() -> Vec<RigCamera> {
    vec![
        nuplan("CAM_F0", [1.65506747, -0.01168732, 1.49112208], [[-0.007859716, -0.022719124, 0.999710991], [-0.999942624, 0.007455161, -0.007692114], [-0.007278249, -0.99971409, -0.022776416]]),
        nuplan("CAM_R0", [1.61828343, -0.15532203, 1.49007665], [[-0.824549012, 0.011657221, 0.565670431], [-0.565283952, 0.02532491, -0.824507552], [-0.023937019, -0.999611304, -0.01429199]]),
        nuplan("CAM_R1", [1.27299407, -0.60973112, 1.37217911], [[-0.926847781, 0.021770159, -0.374805619], [0.374976311, 0.004219641, -0.92702479], [-0.018599932, -0.999754097, -0.012074259]]),
        nuplan("CAM_R2", [-0.48771615, -0.493167, 1.35027683], [[-0.622532449, 0.037068783, -0.781715584], [0.781634335, -0.020000829, -0.62341618], [-0.038744239, -0.999112542, -0.016523068]]),
        nuplan("CAM_B0", [-0.47463312, 0.02368552, 1.4341838], [[0.008025419, 0.010474632, -0.999912934], [0.99989075, -0.012496709, 0.007894331], [-0.012412931, -0.999867048, -0.010573779]]),
        nuplan("CAM_L2", [-0.49561003, 0.54750373, 1.3472672], [[0.635207823, 0.014975164, -0.772196067], [0.772324891, -0.00580669, 0.635201185], [0.005028338, -0.999871005, -0.015254147]]),
        nuplan("CAM_L1", [1.29939471, 0.63819702, 1.36736822], [[0.931201038, 0.002615629, -0.36449662], [0.364471268, -0.02048653, 0.930989257], [-0.005032149, -0.999786708, -0.0200304]]),
        nuplan("CAM_L0", [1.63069485, 0.11956747, 1.48117884], [[0.817767761, -0.005769302, 0.575519421], [-0.575539379, -0.013776281, 0.81765802], [0.003211201, -0.999888458, -0.014586258]]),
    ]
}

/// A camera without roll, `[azimuth, pitch]` of its optical axis in degrees (left and up positive); COLMAP's `[fx, fy, cx, cy]`
/// have pixel centres at +0.5 already.
fn wayve(channel: &str, t: [f64; 3], axis_deg: [f64; 2], [fx, fy, cx, cy]: [f64; 4], k1: f64) -> RigCamera {
    let [azimuth, pitch] = axis_deg.map(f64::to_radians);
    // Columns: camera x (right), y (down), z (forward) of a level camera that looks along ego x.
    let ahead = DMat3::from_cols(DVec3::NEG_Y, DVec3::NEG_Z, DVec3::X);
    let turn = DMat3::from_rotation_z(azimuth) * DMat3::from_rotation_y(-pitch);
    RigCamera {
        channel: channel.to_owned(),
        intrinsics: Intrinsics { fx, fy, cx, cy, width: 1920, height: 1080 },
        lens: Lens::KannalaBrandt { k: [k1, 0.0021, -0.0007, 0.0001] },
        ego_from_cam: pose_from_matrix(turn * ahead, t),
    }
}

#[rustfmt::skip] // a table: one camera per line
fn wayve_cameras() -> Vec<RigCamera> {
    vec![
        wayve("front-forward", [1.75, -0.2, 1.42], [0.0, -3.0], [958.0, 959.0, 957.5, 541.25], -0.012),
        wayve("right-forward", [1.23, -0.785562206004, 1.09], [-50.0, -6.0], [964.0, 965.0, 959.5, 539.25], -0.02),
        wayve("right-backward", [1.15, -0.74921767315, 1.11], [-130.0, -6.0], [970.0, 971.0, 961.5, 537.25], -0.028),
        wayve("left-backward", [1.09, 0.897095562383, 1.11], [130.0, -6.0], [967.0, 968.0, 960.5, 538.25], -0.024),
        wayve("left-forward", [1.15, 0.900954884226, 1.09], [50.0, -6.0], [961.0, 962.0, 958.5, 540.25], -0.016),
    ]
}

/// `rows` of the rotation from Waymo's camera axes (x forward, y left, z up) to the vehicle; `distortion` = k1, k2, p1, p2.
fn waymo(
    channel: &str,
    height: u32,
    f_cx_cy: [f64; 3],
    distortion: [f64; 4],
    t: [f64; 3],
    rows: [[f64; 3]; 3],
) -> RigCamera {
    let [k1, k2, p1, p2] = distortion;
    let vehicle_from_waymo = DMat3::from_cols_array_2d(&rows).transpose();
    // Columns: OpenCV's x, y, z axes in Waymo's camera axes.
    let waymo_from_cam = DMat3::from_cols(DVec3::NEG_Y, DVec3::NEG_Z, DVec3::X);
    RigCamera {
        channel: channel.to_owned(),
        intrinsics: opencv_intrinsics(f_cx_cy, [1920, height]),
        lens: Lens::BrownConrady { k: [k1, k2, 0.0], p: [p1, p2] },
        ego_from_cam: pose_from_matrix(vehicle_from_waymo * waymo_from_cam, t),
    }
}

#[rustfmt::skip] // a table: one number group per line
fn waymo_cameras() -> Vec<RigCamera> {
    vec![
        waymo("SIDE_LEFT", 886, [2053.508, 967.945, 246.656], [0.039622, -0.327464, 0.000960, -0.000229], [1.43191, 0.11107, 2.11500],
            [[0.013197, -0.999913, 0.000081], [0.999602, 0.013194, 0.024943], [-0.024941, -0.000248, 0.999689]]),
        waymo("FRONT_LEFT", 1280, [2056.390, 954.420, 645.993], [0.033087, -0.330093, 0.003240, 0.001315], [1.49324, 0.09140, 2.11480],
            [[0.716340, -0.697651, 0.011861], [0.697483, 0.716432, 0.015573], [-0.019362, -0.002883, 0.999808]]),
        waymo("FRONT", 1280, [2044.508, 949.575, 633.242], [0.040358, -0.330017, 0.001040, -0.001567], [1.53863, -0.02439, 2.11509],
            [[0.999994, -0.002763, 0.001933], [0.002745, 0.999958, 0.008787], [-0.001957, -0.008782, 0.999960]]),
        waymo("FRONT_RIGHT", 1280, [2045.683, 960.086, 646.223], [0.033291, -0.295999, 0.001678, -0.001592], [1.48969, -0.09437, 2.11564],
            [[0.712064, 0.702007, 0.012283], [-0.702070, 0.712107, 0.001186], [-0.007914, -0.009468, 0.999924]]),
        waymo("SIDE_RIGHT", 886, [2064.417, 961.925, 240.937], [0.037505, -0.346239, 0.000348, -0.000419], [1.42765, -0.11168, 2.11600],
            [[-0.001650, 0.999999, -0.000199], [-0.999998, -0.001650, -0.000712], [-0.000712, 0.000198, 1.0]]),
    ]
}

#[cfg(test)]
mod tests {
    use glam::DVec2;

    use super::*;

    /// Azimuth, horizontal field of view, overlap with the next camera, degrees: measured independently of this crate.
    type Row = (&'static str, f64, f64, f64);

    const NUSCENES: &[Row] = &[
        ("CAM_FRONT", 0.3, 64.5, 7.6),
        ("CAM_FRONT_RIGHT", -56.4, 64.8, 10.4),
        ("CAM_BACK_RIGHT", -110.8, 64.8, 8.5),
        ("CAM_BACK", 179.9, 89.3, 4.5),
        ("CAM_BACK_LEFT", 108.6, 64.9, 12.3),
        ("CAM_FRONT_LEFT", 55.2, 64.3, 9.2),
    ];
    const ARGOVERSE2: &[Row] = &[
        ("ring_front_center", 0.0, 47.1, 9.9),
        ("ring_front_right", -45.0, 62.6, 8.7),
        ("ring_side_right", -98.9, 62.6, 8.6),
        ("ring_rear_right", -152.8, 62.4, 8.4),
        ("ring_rear_left", 153.1, 62.6, 8.7),
        ("ring_side_left", 99.2, 62.5, 8.3),
        ("ring_front_left", 44.9, 62.5, 9.8),
    ];
    const NUPLAN: &[Row] = &[
        ("CAM_F0", -0.4, 72.2, 17.1),
        ("CAM_R0", -55.5, 72.2, 15.7),
        ("CAM_R1", -112.0, 72.2, 42.8),
        ("CAM_R2", -141.4, 72.2, 33.2),
        ("CAM_B0", 179.5, 72.2, 33.2),
        ("CAM_L2", 140.6, 72.2, 43.0),
        ("CAM_L1", 111.4, 72.2, 15.7),
        ("CAM_L0", 54.9, 72.2, 16.9),
    ];
    const WAYMO: &[Row] = &[
        ("SIDE_LEFT", 89.2, 50.4, 5.1),
        ("FRONT_LEFT", 44.2, 50.4, 6.2),
        ("FRONT", 0.2, 50.6, 6.1),
        ("FRONT_RIGHT", -44.6, 50.6, 5.0),
        ("SIDE_RIGHT", -90.1, 50.2, -130.2),
    ];

    fn degrees_apart(a: f64, b: f64) -> f64 {
        crate::wrap_angle((a - b).to_radians()).to_degrees().abs()
    }

    #[test]
    fn views_agree_with_the_table_of_the_specification() {
        let tables = [
            (RigPreset::NuScenes, NUSCENES),
            (RigPreset::Argoverse2, ARGOVERSE2),
            (RigPreset::NuPlan, NUPLAN),
            (RigPreset::Waymo, WAYMO),
        ];
        for (preset, table) in tables {
            let rig = preset.rig();
            assert_eq!(rig.len(), table.len());
            for (i, (channel, azimuth, fov, overlap)) in table.iter().enumerate() {
                let camera = &rig.cameras[i];
                let (left, right) = camera.horizontal_span().unwrap();
                let got = (
                    camera.azimuth().to_degrees(),
                    (left - right).to_degrees(),
                    rig.overlap(i, (i + 1) % rig.len()).unwrap().to_degrees(),
                );
                assert_eq!(camera.channel, *channel);
                assert!(degrees_apart(got.0, *azimuth) < 0.2, "{channel}: azimuth {got:?}");
                assert!((got.1 - fov).abs() < 0.2, "{channel}: field of view {got:?}");
                assert!((got.2 - overlap).abs() < 0.3, "{channel}: overlap {got:?}");
            }
        }
    }

    #[test]
    fn presets_are_listed_in_rig_order() {
        for preset in RigPreset::ALL {
            let rig = preset.rig();
            let listed: Vec<usize> = (0..rig.len()).collect();
            assert_eq!(rig.rig_order().unwrap(), listed, "{preset:?}");
            if preset != RigPreset::Waymo {
                assert_eq!(rig.clockwise_order(), listed, "{preset:?}");
            }
        }
        assert_eq!(RigPreset::Waymo.rig().clockwise_order(), [2, 3, 4, 0, 1]);
    }

    #[test]
    fn only_the_rig_without_a_rear_view_is_open() {
        for preset in RigPreset::ALL {
            let rig = preset.rig();
            let adjacency = rig.adjacency().unwrap();
            let last = rig.len() - 1;
            assert_eq!(adjacency.closed, preset != RigPreset::Waymo, "{preset:?}");
            for i in 0..last {
                assert_eq!(adjacency.right[i], Some(i + 1), "{preset:?}");
                assert_eq!(adjacency.left[i + 1], Some(i), "{preset:?}");
            }
            assert_eq!(adjacency.right[last], adjacency.closed.then_some(0), "{preset:?}");
        }
    }

    #[test]
    fn cameras_stand_upright_and_look_along_their_names() {
        for preset in RigPreset::ALL {
            let rig = preset.rig();
            for camera in &rig.cameras {
                let down = camera.ego_from_cam.transform_vector(DVec3::Y);
                assert!(down.z < -0.98, "{}: picture rows run down", camera.channel);
                assert!((1.0..2.3).contains(&camera.ego_from_cam.translation.z), "{}", camera.channel);
                let i = camera.intrinsics;
                let corner = DVec2::new(f64::from(i.width), f64::from(i.height));
                let model = camera.camera().unwrap();
                for pixel in [DVec2::ZERO, corner, corner * 0.5] {
                    let back = model.project(model.unproject(pixel).unwrap()).unwrap();
                    assert!((back - pixel).length() < 1e-8, "{}", camera.channel);
                }
            }
            // The front camera has a positive x translation and looks along +x within 5 degrees.
            let front = &rig.cameras[rig.clockwise_order()[0]];
            assert!(front.ego_from_cam.translation.x > 1.0);
            assert!(front.ego_from_cam.transform_vector(DVec3::Z).angle_between(DVec3::X).to_degrees() < 5.0);
        }
    }

    #[test]
    fn half_pixels_are_added_to_opencv_files_only() {
        assert_eq!(RigPreset::NuScenes.rig().cameras[0].intrinsics.cx, 816.2670 + 0.5);
        assert_eq!(RigPreset::Waymo.rig().cameras[0].intrinsics.cy, 246.656 + 0.5);
        assert_eq!(RigPreset::WayveScenes101.rig().cameras[0].intrinsics.cx, 957.5);
    }

    #[test]
    fn the_wayve_baselines_are_the_published_ones() {
        let rig = RigPreset::WayveScenes101.rig();
        let front = rig.cameras[0].ego_from_cam.translation;
        // right-forward, right-backward, left-backward, left-forward of the US vehicles.
        for (camera, metres) in rig.cameras[1..].iter().zip([0.849814, 0.870483, 1.317315, 1.296534]) {
            let distance = camera.ego_from_cam.translation.distance(front);
            assert!((distance - metres).abs() < 1e-6, "{}: {distance}", camera.channel);
        }
    }

    #[test]
    fn configs_name_presets_as_the_enum_does() {
        for preset in RigPreset::ALL {
            let name = format!("\"{}\"", preset.name());
            assert_eq!(serde_json::to_string(&preset).unwrap(), name);
            assert_eq!(serde_json::from_str::<RigPreset>(&name).unwrap(), preset);
        }
    }
}

//! Measures rendering speed with a nuScenes-like rig of six cameras, and writes contact sheets.
//!
//! `cargo run --release -p world --example render_speed -- [--out DIR] [--seeds N] [--seconds S]`

use std::path::{Path, PathBuf};
use std::time::Instant;

use geometry::{Camera, Intrinsics, Lens, Rigid};
use glam::{DMat3, DQuat, DVec3};
use image::RgbImage;
use world::{RenderOptions, Rendering, World, WorldConfig};

/// Azimuth in degrees, focal length at 1600 x 900, mounting point.
const RIG: [(f64, f64, [f64; 3]); 6] = [
    (0.3, 1266.4, [1.70, 0.0, 1.51]),
    (-56.4, 1260.8, [1.55, -0.49, 1.50]),
    (-110.8, 1259.5, [1.01, -0.48, 1.56]),
    (179.9, 809.2, [0.03, 0.0, 1.58]),
    (108.6, 1256.7, [1.04, 0.48, 1.59]),
    (55.2, 1272.6, [1.52, 0.49, 1.51]),
];

fn camera(index: usize, width: u32, height: u32) -> (Camera, Rigid) {
    let (azimuth, focal, mount) = RIG[index];
    let (sx, sy) = (f64::from(width) / 1600.0, f64::from(height) / 900.0);
    let intrinsics = Intrinsics { fx: focal * sx, fy: focal * sy, cx: 800.0 * sx, cy: 480.0 * sy, width, height };
    let camera = Camera::new(intrinsics, Lens::Pinhole).expect("sound intrinsics");
    // Columns: the camera's right, down and forward axes in ego.
    let axes = DMat3::from_cols(DVec3::NEG_Y, DVec3::NEG_Z, DVec3::X);
    let turn = DQuat::from_rotation_z(azimuth.to_radians());
    let ego_from_cam = Rigid::new(turn * DQuat::from_mat3(&axes), DVec3::from_array(mount));
    (camera, ego_from_cam)
}

/// Seconds this thread has spent on a core, where the system tells (Linux); the wall clock misleads on a busy machine.
fn thread_cpu_secs() -> Option<f64> {
    let text = std::fs::read_to_string("/proc/thread-self/schedstat").ok()?;
    Some(text.split_whitespace().next()?.parse::<f64>().ok()? * 1e-9)
}

/// Views per second of wall clock, and per second if both threads had a core of their own.
fn views_per_second(worlds: &[World], width: u32, height: u32, seconds: f64) -> (f64, Option<f64>) {
    let spent = std::sync::Mutex::new(Some(0.0));
    let rounds = std::sync::atomic::AtomicUsize::new(0);
    let start = Instant::now();
    std::thread::scope(|scope| {
        for thread in 0..2usize {
            let (rounds, spent) = (&rounds, &spent);
            scope.spawn(move || {
                let mut round = thread;
                while start.elapsed().as_secs_f64() < seconds {
                    let world = &worlds[round % worlds.len()];
                    let time = (round as f64 * 1.37) % world.duration_secs();
                    let (snapshot, pose) = (world.snapshot(time), world.world_from_ego(time));
                    for index in 0..RIG.len() {
                        let (camera, ego_from_cam) = camera(index, width, height);
                        let view = snapshot.render_serial(&camera, &(pose * ego_from_cam), &RenderOptions::default());
                        std::hint::black_box(view);
                    }
                    rounds.fetch_add(1, std::sync::atomic::Ordering::Relaxed);
                    round += 2;
                }
                let mut sum = spent.lock().expect("no thread panicked");
                *sum = sum.zip(thread_cpu_secs()).map(|(a, b)| a + b);
            });
        }
    });
    let views = rounds.into_inner() * RIG.len();
    let spent = spent.into_inner().expect("no thread panicked");
    (views as f64 / start.elapsed().as_secs_f64(), spent.map(|secs| 2.0 * views as f64 / secs))
}

fn paste(sheet: &mut RgbImage, view: &Rendering, x: u32, y: u32) {
    for row in 0..view.height {
        for column in 0..view.width {
            let at = ((row * view.width + column) * 3) as usize;
            sheet.put_pixel(x + column, y + row, image::Rgb([view.rgb[at], view.rgb[at + 1], view.rgb[at + 2]]));
        }
    }
}

/// One row per world: left to right FRONT_LEFT, FRONT, FRONT_RIGHT, BACK_RIGHT, BACK, BACK_LEFT.
fn contact_sheet(worlds: &[World], width: u32, height: u32, file: &Path) {
    const ORDER: [usize; 6] = [5, 0, 1, 2, 3, 4];
    let mut sheet = RgbImage::new(width * 6, height * worlds.len() as u32);
    for (row, world) in worlds.iter().enumerate() {
        let time = world.duration_secs() * 0.4;
        let (snapshot, pose) = (world.snapshot(time), world.world_from_ego(time));
        for (column, index) in ORDER.into_iter().enumerate() {
            let (camera, ego_from_cam) = camera(index, width, height);
            let view = snapshot.render(&camera, &(pose * ego_from_cam), &RenderOptions::default());
            paste(&mut sheet, &view, column as u32 * width, row as u32 * height);
        }
    }
    sheet.save(file).expect("writable folder");
}

#[allow(clippy::print_stdout)]
fn main() {
    let arguments: Vec<String> = std::env::args().collect();
    let value = |name: &str| arguments.iter().position(|a| a == name).and_then(|i| arguments.get(i + 1));
    let seeds: u64 = value("--seeds").map_or(8, |v| v.parse().expect("--seeds takes a number"));
    let first: u64 = value("--first").map_or(0, |v| v.parse().expect("--first takes a number"));
    let seconds: f64 = value("--seconds").map_or(3.0, |v| v.parse().expect("--seconds takes a number"));
    let start = Instant::now();
    let worlds: Vec<World> =
        (first..first + seeds).map(|seed| World::generate(seed, &WorldConfig::default())).collect();
    println!("generate: {:.1} ms per world", start.elapsed().as_secs_f64() * 1e3 / seeds as f64);
    let start = Instant::now();
    for step in 0..200 {
        std::hint::black_box(worlds[step % worlds.len()].snapshot(step as f64 * 0.1));
    }
    println!("snapshot: {:.3} ms", start.elapsed().as_secs_f64() * 5.0);
    if let Some(folder) = value("--out").map(PathBuf::from) {
        for world in &worlds {
            println!("seed {}: {}", world.seed(), world.caption());
        }
        contact_sheet(&worlds, 400, 224, &folder.join("large.png"));
        contact_sheet(&worlds, 64, 64, &folder.join("small.png"));
    }
    for (width, height) in [(64, 64), (400, 224)] {
        let speed = views_per_second(&worlds, width, height, seconds);
        let (wall, undisturbed) = speed;
        let undisturbed = undisturbed.map_or(String::new(), |v| format!(", {v:.0} if both cores were free"));
        println!("{width}x{height}: {wall:.0} views/s on two threads{undisturbed}");
    }
}

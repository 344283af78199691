//! Measures how long the nuScenes tables take to open, what they need, and how fast a frame's records are found in them.
//!
//! `cargo bench -p data --bench table_scale -- --root DIR [--version v1.0-trainval] [--all] [--frames N]`
//!
//! Only the tables are needed, no pictures. `--all` takes every set of pictures (12 Hz) instead of the key frames.

use std::time::Instant;

use data::SceneDataset;
use data::nuscenes::{FrameChoice, NuScenes, NuScenesConfig};

#[allow(clippy::print_stdout)]
fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let value = |name: &str| arguments.iter().position(|a| a == name).and_then(|i| arguments.get(i + 1));
    let root = value("--root").expect("--root names the folder that holds the tables");
    let version = value("--version").map_or("v1.0-trainval", String::as_str);
    let frames: usize = value("--frames").map_or(20_000, |v| v.parse().expect("--frames takes a number"));
    let mut config = NuScenesConfig::new(root, version);
    if arguments.iter().any(|a| a == "--all") {
        config.frames = FrameChoice::all_pictures();
    }
    let start = Instant::now();
    let dataset = NuScenes::open(&config).expect("sound tables");
    let load_secs = start.elapsed().as_secs_f64();
    let load_cpu = cpu_secs().map_or("unknown".to_owned(), |secs| format!("{secs:.2}"));
    let peak = status("VmHWM").map_or("unknown".to_owned(), |bytes| format!("{:.0}", bytes / 1e6));
    let held = status("VmRSS").map_or("unknown".to_owned(), |bytes| format!("{:.0}", bytes / 1e6));
    let boxes = find(&dataset, frames);
    println!("| frames | load s | CPU s | peak MB | held MB | us per random frame | boxes per frame |");
    println!("|---|---|---|---|---|---|---|");
    let (us, boxes) = (boxes.0 * 1e6, boxes.1);
    println!("| {} | {load_secs:.2} | {load_cpu} | {peak} | {held} | {us:.1} | {boxes:.1} |", dataset.len());
}

/// Seconds for one random frame, by this thread's core where the system tells, and boxes in it.
fn find(dataset: &NuScenes, frames: usize) -> (f64, f64) {
    let mut state = 1u64;
    let mut boxes = 0;
    let (start, cpu) = (Instant::now(), thread_cpu_secs());
    for _ in 0..frames {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        let frame = dataset.frame((state >> 33) as usize % dataset.len()).expect("sound tables");
        boxes += frame.boxes.map_or(0, |boxes| boxes.len());
    }
    let spent = thread_cpu_secs().zip(cpu).map_or(start.elapsed().as_secs_f64(), |(now, before)| now - before);
    (spent / frames as f64, boxes as f64 / frames as f64)
}

fn thread_cpu_secs() -> Option<f64> {
    let text = std::fs::read_to_string("/proc/thread-self/schedstat").ok()?;
    Some(text.split_whitespace().next()?.parse::<f64>().ok()? * 1e-9)
}

/// Seconds on a core of all threads that live (those of the reader's pool live on).
fn cpu_secs() -> Option<f64> {
    let secs = |thread: std::io::Result<std::fs::DirEntry>| {
        let text = std::fs::read_to_string(thread.ok()?.path().join("schedstat")).ok()?;
        Some(text.split_whitespace().next()?.parse::<f64>().ok()? * 1e-9)
    };
    std::fs::read_dir("/proc/self/task").ok()?.map(secs).sum()
}

/// A line of the process's status, bytes.
fn status(name: &str) -> Option<f64> {
    let text = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = text.lines().find(|line| line.starts_with(name))?;
    Some(line.split_whitespace().nth(1)?.parse::<f64>().ok()? * 1024.0)
}

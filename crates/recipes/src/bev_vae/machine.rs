//! What this machine can do: speed of matrix products and free memory.

use std::time::Instant;

use burn::tensor::{Device, Tensor};

/// Share of the matrix product's speed that whole steps reach, from the toy run's time.
const EFFICIENCY: f64 = 0.25;

/// Operations per second of a matrix product on this device, the best of three.
pub fn operations_per_second(device: &Device) -> f64 {
    const SIDE: usize = 512;
    let matrix = Tensor::<2>::ones([SIDE, SIDE], device);
    let once = || {
        let clock = Instant::now();
        let product = matrix.clone().matmul(matrix.clone());
        // Reading one number waits for a device that works behind our back.
        let _: f32 = product.slice([0..1, 0..1]).into_scalar();
        clock.elapsed().as_secs_f64()
    };
    let seconds = (0..3).map(|_| once()).fold(f64::INFINITY, f64::min);
    2.0 * (SIDE as f64).powi(3) / seconds.max(1e-9)
}

/// How long so many operations take at this speed of matrix products, in words.
pub fn duration(operations: f64, operations_per_second: f64) -> String {
    let seconds = operations / (EFFICIENCY * operations_per_second);
    match seconds {
        s if s < 120.0 => format!("{s:.0} s"),
        s if s < 7200.0 => format!("{:.0} min", s / 60.0),
        s if s < 172_800.0 => format!("{:.1} h", s / 3600.0),
        s => format!("{:.0} days", s / 86_400.0),
    }
}

/// Bytes that this process may still take: what the system has free, or its control group allows. `None` where neither is known.
pub fn free_memory() -> Option<f64> {
    let system = std::fs::read_to_string("/proc/meminfo").ok().and_then(|text| {
        let line = text.lines().find_map(|line| line.strip_prefix("MemAvailable:"))?;
        Some(line.split_whitespace().next()?.parse::<f64>().ok()? * 1024.0)
    });
    let read = |name: &str| std::fs::read_to_string(format!("/sys/fs/cgroup/{name}")).ok()?.trim().parse::<f64>().ok();
    let group = read("memory.max").zip(read("memory.current")).map(|(most, used)| (most - used).max(0.0));
    match (system, group) {
        (Some(system), Some(group)) => Some(system.min(group)),
        (system, group) => system.or(group),
    }
}

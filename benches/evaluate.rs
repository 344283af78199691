//! How fast pairs of six-view frames are evaluated, and whether memory stays flat: PSNR, SSIM, one Fréchet distance.
//!
//! `cargo bench --bench evaluate -- FRAMES [WEIGHTS]`; without a folder of weights the Fréchet distance takes the mean colours of an 8x8 grid
//! as features, which costs nothing, so that everything but a network is measured. The peer is `tests/peers/metrics_rate.py`.

use std::ops::Range;
use std::path::PathBuf;
use std::time::Instant as Clock;

use metrics::{Moments, Protocol, Raster, ResizeFilter, frechet_distance};
use rigscape::evaluate::{Instant, NetworkFolder, Pass, PassOptions, PictureSource, Shot, Side};
use train::DeviceConfig;

const SIDE: usize = 256;
const VIEWS: usize = 6;

/// Pictures out of a formula, different for every frame and view.
struct Made {
    frames: usize,
    noise: u32,
}

impl PictureSource for Made {
    fn describe(&self) -> String {
        "made pictures".to_owned()
    }

    fn len(&self) -> usize {
        self.frames
    }

    fn scenes(&self) -> Vec<Range<usize>> {
        std::iter::once(0..self.frames).collect()
    }

    fn name(&self, index: usize) -> anyhow::Result<String> {
        Ok(index.to_string())
    }

    fn instant(&self, index: usize) -> anyhow::Result<Instant> {
        let shot = |view: usize| {
            let seed = (index * VIEWS + view) as u32;
            let value = |at: usize| {
                let (x, y, c) = ((at / 3 % SIDE) as u32, (at / 3 / SIDE) as u32, (at % 3) as u32);
                let wave = (x * (3 + seed % 5) + y * (2 + seed % 7) + 40 * c + seed) / 4 % 160;
                let grain = (at as u32 ^ seed).wrapping_mul(2_654_435_761) >> 27;
                (wave + if self.noise > 0 { grain * self.noise } else { 0 }).min(255) as u8
            };
            let pixels = (0..SIDE * SIDE * 3).map(value).collect();
            Shot { channel: view.to_string(), picture: Raster { height: SIDE, width: SIDE, pixels } }
        };
        let views: Vec<Shot> = (0..VIEWS).map(shot).collect();
        Ok(Instant { name: index.to_string(), key_frame: true, right_of: vec![None; VIEWS], front: 0, views })
    }
}

/// Resident memory of this process, MB; `None` where the system does not tell.
fn resident_mb() -> Option<f64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find(|line| line.starts_with("VmRSS:"))?;
    Some(line.split_whitespace().nth(1)?.parse::<f64>().ok()? / 1024.0)
}

fn protocols(names: &[&str]) -> Vec<Protocol> {
    let known = Protocol::built_in().expect("the built-in protocols are sound");
    names.iter().filter_map(|name| known.iter().find(|protocol| protocol.name == **name)).cloned().collect()
}

fn options(names: &[&str]) -> PassOptions {
    PassOptions { protocols: protocols(names), size: None, batch: 16, seed: 0, worst: 6 }
}

#[allow(clippy::print_stdout)]
fn main() -> anyhow::Result<()> {
    let mut args = std::env::args().skip(1).filter(|arg| arg != "--bench");
    let frames: usize = args.next().map_or(Ok(60), |count| count.parse())?;
    let folders: Vec<PathBuf> = args.map(PathBuf::from).collect();
    let networks = NetworkFolder { folders: folders.clone(), device: DeviceConfig::Flex.open()? };
    let threads = rayon::current_num_threads();
    println!("{threads} threads; made pictures, {VIEWS} views of {SIDE}x{SIDE}; both sides are made within the time");

    for names in [&["psnr/bev-vae"][..], &["ssim/gauss11"], &["ssim/skimage7"]] {
        let mut pass = Pass::new(&options(names), &networks)?;
        let clock = Clock::now();
        pass.paired(&Made { frames, noise: 0 }, &Made { frames, noise: 1 })?;
        println!("{:<34} {:>8.2} frames/s", names.join(" "), frames as f64 / clock.elapsed().as_secs_f64());
    }
    let clock = Clock::now();
    let mut moments = [Moments::new(192), Moments::new(192)];
    let mut pass = Pass::new(&options(&["psnr/bev-vae", "ssim/gauss11"]), &networks)?;
    for part in 0..4 {
        pass.paired(&Made { frames: frames / 4, noise: 0 }, &Made { frames: frames / 4, noise: 1 })?;
        for (moments, noise) in moments.iter_mut().zip([0, 1]) {
            grid_colours(moments, &Made { frames: frames / 4, noise })?;
        }
        println!(
            "  after {:>5} frames {:>8.1} MB resident",
            (part + 1) * (frames / 4),
            resident_mb().unwrap_or(f64::NAN)
        );
    }
    let [real, generated] = &moments;
    let distance = frechet_distance(&real.statistics("real")?, &generated.statistics("generated")?)?;
    let seconds = clock.elapsed().as_secs_f64();
    println!(
        "PSNR, SSIM 11x11, grid distance {:>10.3}  {:>6.2} frames/s",
        distance.value,
        (frames / 4 * 4) as f64 / seconds
    );
    if folders.is_empty() {
        return Ok(());
    }
    let mut pass = Pass::new(&options(&["psnr/bev-vae", "ssim/gauss11", "fid/plain"]), &networks)?;
    let clock = Clock::now();
    pass.paired(&Made { frames, noise: 0 }, &Made { frames, noise: 1 })?;
    println!("  after {frames:>5} frames {:>8.1} MB resident", resident_mb().unwrap_or(f64::NAN));
    for stream in &pass.streams {
        let [real, generated] =
            [Side::Real, Side::Generated].map(|side| stream.side(side).moments.statistics("a side"));
        let distance = frechet_distance(&generated?, &real?)?;
        let name = stream.loaded.stand_in.clone().unwrap_or_default();
        println!(
            "PSNR, SSIM 11x11, fid-{name} {:.4}  {:>6.2} frames/s",
            distance.value,
            frames as f64 / clock.elapsed().as_secs_f64()
        );
    }
    Ok(())
}

fn grid_colours(moments: &mut Moments, source: &Made) -> anyhow::Result<()> {
    for index in 0..source.frames {
        for shot in source.instant(index)?.views {
            let small = shot.picture.resized(8, 8, ResizeFilter::PilBilinear);
            moments.update(&small.pixels.iter().map(|value| f32::from(*value) / 255.0).collect::<Vec<_>>())?;
        }
    }
    Ok(())
}

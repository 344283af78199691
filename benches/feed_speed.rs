//! Measures how fast pictures are fed to training: six 1600x900 JPEG views a frame, brought to 256x256.
//!
//! `cargo bench -p data --bench feed_speed -- [--pictures DIR] [--seconds S]`
//!
//! DIR is searched for JPEG files of that size (a nuScenes `samples` folder). Without it the six pictures of the test data under
//! `RIGSCAPE_DATA` are taken, and without those six rendered ones. All of them lie in the page cache after the first round.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Instant;

use data::conditions::{LatentRays, RaySampling};
use data::{
    Capabilities, DataError, DatasetConfig, FrameId, ImageSize, ImageSource, Loader, LoaderConfig, Mixture,
    MixtureConfig, Sample, SampleOptions, SceneDataset, SceneFrame, View,
};
use geometry::{ImageEdit, RigPreset, Rigid};
use image::{ImageEncoder, RgbImage};

const RAW: (u32, u32) = (1600, 900);
const SIZE: ImageSize = ImageSize::square(256);
const VIEWS: usize = 6;
const WORKERS: usize = 2;

/// Frames of six picture files.
struct Files(Vec<PathBuf>);

impl SceneDataset for Files {
    fn len(&self) -> usize {
        self.0.len() / VIEWS
    }

    fn frame(&self, index: usize) -> Result<SceneFrame, DataError> {
        let rig = RigPreset::NuScenes.rig();
        let views = rig
            .cameras
            .iter()
            .zip(&self.0[index * VIEWS..])
            .map(|(camera, path)| View { image: Some(source(path)), ..View::of_camera(camera, Rigid::IDENTITY) });
        Ok(SceneFrame {
            id: FrameId { dataset: "files".into(), scene: "one".into(), frame: index.to_string() },
            timestamp_ns: 0,
            world_from_ego: Rigid::IDENTITY,
            views: views.collect(),
            boxes: None,
            scene_text: None,
        })
    }

    fn scene_ranges(&self) -> Vec<std::ops::Range<usize>> {
        std::iter::once(0..self.len()).collect()
    }

    fn name(&self) -> &str {
        "files"
    }

    fn capabilities(&self) -> Capabilities {
        Capabilities::default()
    }

    fn max_views(&self) -> usize {
        VIEWS
    }
}

fn source(path: &Path) -> ImageSource {
    ImageSource::File { file: path.to_owned().into(), size: RAW }
}

#[allow(clippy::print_stdout)]
fn main() {
    let arguments: Vec<String> = std::env::args().collect();
    let value = |name: &str| arguments.iter().position(|a| a == name).and_then(|i| arguments.get(i + 1));
    let seconds: f64 = value("--seconds").map_or(3.0, |v| v.parse().expect("--seconds takes a number"));
    let scratch = tempfile::tempdir().expect("a writable temporary folder");
    let files = pictures(value("--pictures").map(PathBuf::from), scratch.path());
    let bytes: Vec<Vec<u8>> = files.iter().map(|file| std::fs::read(file).expect("a picture")).collect();
    let mean = bytes.iter().map(Vec::len).sum::<usize>() / bytes.len();
    println!("{} pictures of {}x{}, {} kB in the mean", files.len(), RAW.0, RAW.1, mean / 1000);
    println!("| stage | ms per picture | pictures/s per core | dB against row 2 |\n|---|---|---|---|");
    stages(&files, seconds);
    scaled_codecs(&files, &bytes, seconds, scratch.path());
    loader(files, seconds);
    rays(seconds);
}

/// Occupancy along the rays of six latent pictures of 28x50 cells, foreground and background apart: 320 samples of 0.2 m.
#[allow(clippy::print_stdout)]
fn rays(seconds: f64) {
    let config =
        toml::from_str("name = \"world\"\nseed = 1\nscenes = 4\nframes_per_scene = 2\nrig = { preset = \"nuscenes\" }");
    let dataset = data::open(&DatasetConfig::Procedural(config.expect("a config"))).expect("a procedural dataset");
    let frames: Vec<_> = (0..dataset.len())
        .map(|at| (dataset.frame(at).expect("a frame"), dataset.occupancy(at).expect("occupancy")))
        .collect();
    let filled = |at: usize| {
        let (frame, grid) = &frames[at];
        let of_view = |view: &View| {
            let camera = view.camera().expect("a sound camera");
            let raw = &view.intrinsics;
            let edit = ImageEdit::identity(raw.width, raw.height).resize(400, 225).crop(0, 1, 400, 224);
            let labels =
                LatentRays::new(&camera, &edit, &view.ego_from_cam, [28, 50]).sample(grid, &RaySampling::default());
            let foreground = grid.label_set.foreground();
            let parts = [labels.only(foreground), labels.without(foreground)];
            parts.iter().flat_map(|part| part.first_hits()).flatten().count()
        };
        frame.views.iter().map(of_view).sum::<usize>()
    };
    let hits: usize = (0..frames.len()).map(filled).sum();
    let secs = time(frames.len(), seconds, |at| assert!(filled(at) > 0));
    println!("occupancy rays: {:.0} six-view frames/s per core, {} hits a frame", 1.0 / secs, hits / frames.len());
}

/// What one view goes through, each stage with all stages before it.
fn stages(files: &[PathBuf], seconds: f64) {
    let edit = shrink(RAW);
    let decode = |at: usize| drop(source(&files[at]).decode().expect("a sound picture"));
    row("read, decode strictly (zune-jpeg)", time(files.len(), seconds, decode), None);
    let load = |at: usize| drop(source(&files[at]).load(&edit).expect("a sound picture"));
    row("and area average to 256x256", time(files.len(), seconds, load), None);
    let dataset = Files(files.to_vec());
    let options = SampleOptions { size: SIZE, pose_mode: data::PoseMode::Compensated };
    let sample = |at: usize| drop(dataset.frame(at).and_then(|frame| Sample::load(&frame, &options)));
    row("and planes in [0, 1]", time(dataset.len(), seconds, sample) / VIEWS as f64, None);
}

/// jpeg-decoder, which can leave the high frequencies out: whole, half and quarter size, averaged on from there.
fn scaled_codecs(files: &[PathBuf], bytes: &[Vec<u8>], seconds: f64, scratch: &Path) {
    for divisor in [1, 2, 4] {
        let (width, height) = (RAW.0.div_ceil(divisor), RAW.1.div_ceil(divisor));
        let decode = |at: usize| {
            let mut decoder = jpeg_decoder::Decoder::new(bytes[at].as_slice());
            decoder.scale(width as u16, height as u16).expect("a sound header");
            decoder.decode().expect("a sound picture")
        };
        let secs = time(bytes.len(), seconds, |at| drop(decode(at)));
        let error: f64 = (0..bytes.len())
            .map(|at| {
                let picture = RgbImage::from_raw(width, height, decode(at)).expect("a picture of the asked size");
                let path = scratch.join("scaled.png");
                picture.save(&path).expect("a writable temporary folder");
                let scaled = ImageSource::File { file: path.into(), size: (width, height) };
                let got = scaled.load(&shrink((width, height))).expect("the picture just written");
                squared_error(&got, &source(&files[at]).load(&shrink(RAW)).expect("a sound picture"))
            })
            .sum();
        let decibel = 10.0 * (255.0f64.powi(2) / (error / bytes.len() as f64)).log10();
        row(&format!("decode only, jpeg-decoder at 1/{divisor}"), secs, Some(decibel));
    }
}

/// From any size to the network's.
fn shrink((width, height): (u32, u32)) -> ImageEdit {
    ImageEdit::identity(width, height).resize(SIZE.width, SIZE.height)
}

fn squared_error(a: &RgbImage, b: &RgbImage) -> f64 {
    let sum: f64 = a.as_raw().iter().zip(b.as_raw()).map(|(a, b)| (f64::from(*a) - f64::from(*b)).powi(2)).sum();
    sum / a.as_raw().len() as f64
}

/// The whole path: worker threads, augmentation off, batches assembled.
#[allow(clippy::print_stdout)]
fn loader(files: Vec<PathBuf>, seconds: f64) {
    let dataset: Arc<dyn SceneDataset> = Arc::new(Files(files));
    let mixture = Mixture::new(vec![dataset], &MixtureConfig::default(), 2, 0).expect("a mixture of one dataset");
    let config = LoaderConfig { size: SIZE, workers: WORKERS, ..LoaderConfig::default() };
    let mut loader = Loader::new(Arc::new(mixture), config, 0).expect("a loader");
    loader.next_batch().expect("sound pictures");
    let (start, cpu, mut views) = (Instant::now(), process_cpu_secs(), 0);
    while start.elapsed().as_secs_f64() < seconds {
        views += loader.next_batch().expect("sound pictures").input.mask.len();
    }
    let wall = start.elapsed().as_secs_f64();
    let spent = process_cpu_secs().zip(cpu).map(|(now, before)| now - before);
    row("the loader as a whole", spent.unwrap_or(wall * WORKERS as f64) / views as f64, None);
    println!("{:.0} pictures/s by the wall clock with {WORKERS} workers", views as f64 / wall);
}

#[allow(clippy::print_stdout)]
fn row(name: &str, secs: f64, decibel: Option<f64>) {
    let decibel = decibel.map_or(String::new(), |decibel| format!("{decibel:.1}"));
    println!("| {name} | {:.2} | {:.0} | {decibel} |", secs * 1e3, 1.0 / secs);
}

/// Seconds of this thread's core for one call, over at least `seconds`.
fn time(count: usize, seconds: f64, call: impl Fn(usize)) -> f64 {
    (0..count).for_each(&call);
    let (start, cpu, mut calls) = (Instant::now(), thread_cpu_secs(Path::new("/proc/thread-self")), 0usize);
    while start.elapsed().as_secs_f64() < seconds {
        (0..count).for_each(&call);
        calls += count;
    }
    let spent = thread_cpu_secs(Path::new("/proc/thread-self")).zip(cpu).map(|(now, before)| now - before);
    spent.unwrap_or(start.elapsed().as_secs_f64()) / calls as f64
}

/// Seconds a thread has spent on a core, where the system tells (Linux); the wall clock misleads on a busy machine.
fn thread_cpu_secs(thread: &Path) -> Option<f64> {
    let text = std::fs::read_to_string(thread.join("schedstat")).ok()?;
    Some(text.split_whitespace().next()?.parse::<f64>().ok()? * 1e-9)
}

/// The same for all threads that live.
fn process_cpu_secs() -> Option<f64> {
    let threads = std::fs::read_dir("/proc/self/task").ok()?;
    threads.map(|thread| thread_cpu_secs(&thread.ok()?.path())).sum()
}

/// At least six pictures, a multiple of six.
fn pictures(folder: Option<PathBuf>, scratch: &Path) -> Vec<PathBuf> {
    let shipped = std::env::var_os("RIGSCAPE_DATA").map(|data| Path::new(&data).join("nuscenes_keyframe/samples"));
    let mut found = Vec::new();
    if let Some(folder) = folder.or(shipped) {
        search(&folder, &mut found);
        assert!(found.len() >= VIEWS, "{} holds less than {VIEWS} pictures of {RAW:?}", folder.display());
    } else {
        found = rendered(scratch);
    }
    found.sort();
    found.truncate(found.len() / VIEWS * VIEWS);
    found
}

fn search(folder: &Path, found: &mut Vec<PathBuf>) {
    for entry in std::fs::read_dir(folder).expect("a readable folder") {
        let path = entry.expect("a readable folder").path();
        if path.is_dir() {
            search(&path, found);
        } else if path.extension().is_some_and(|end| end == "jpg") && image::image_dimensions(&path).ok() == Some(RAW) {
            found.push(path);
        }
    }
}

/// Rendered views with noise like a sensor's, so that the files are as long as real ones.
fn rendered(folder: &Path) -> Vec<PathBuf> {
    let world = world::World::generate(1, &world::WorldConfig::default());
    let (snapshot, pose) = (world.snapshot(2.0), world.world_from_ego(2.0));
    let view = |(index, mounted): (usize, &geometry::RigCamera)| {
        let camera = mounted.camera().expect("sound intrinsics");
        let mut seen = snapshot.render(&camera, &(pose * mounted.ego_from_cam), &world::RenderOptions::default());
        let mut state = index as u32 + 1;
        for value in &mut seen.rgb {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            *value = value.saturating_add_signed((state >> 24) as i8 / 32);
        }
        let path = folder.join(format!("{index}.jpg"));
        let file = std::fs::File::create(&path).expect("a writable temporary folder");
        image::codecs::jpeg::JpegEncoder::new_with_quality(std::io::BufWriter::new(file), 75)
            .write_image(&seen.rgb, seen.width, seen.height, image::ExtendedColorType::Rgb8)
            .expect("a writable temporary folder");
        path
    };
    RigPreset::NuScenes.rig().cameras.iter().enumerate().map(view).collect()
}

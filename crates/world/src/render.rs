//! Pictures: one exact ray per pixel through the lens, more where a pixel lies on an edge.

use geometry::{Camera, Rigid};
use glam::{DMat3, DVec2, Vec3};
use rayon::prelude::*;

use crate::bvh::Ray;
use crate::rendering::{RenderOptions, Rendering, SKY_LABEL};
use crate::snapshot::{FAR_M, Met, Snapshot};

/// Result of the ray through a pixel's centre.
#[derive(Debug, Clone, Copy)]
struct Sample {
    color: [f32; 3],
    depth: f32,
    instance: u32,
    /// Tells surfaces apart: neighbours with another key lie across an edge.
    key: u32,
    semantic: u8,
}

/// A camera at a place.
struct View<'a> {
    camera: &'a Camera,
    world_from_cam: DMat3,
    origin: Vec3,
    /// Angle of a pixel, radians.
    spread: f32,
}

impl Snapshot {
    /// Renders with all of rayon's threads.
    pub fn render(&self, camera: &Camera, world_from_cam: &Rigid, options: &RenderOptions) -> Rendering {
        self.render_rows(camera, world_from_cam, options, true)
    }

    /// Renders on the calling thread; the same bytes as [`Snapshot::render`].
    pub fn render_serial(&self, camera: &Camera, world_from_cam: &Rigid, options: &RenderOptions) -> Rendering {
        self.render_rows(camera, world_from_cam, options, false)
    }

    fn render_rows(
        &self,
        camera: &Camera,
        world_from_cam: &Rigid,
        options: &RenderOptions,
        parallel: bool,
    ) -> Rendering {
        let (width, height) = (camera.intrinsics.width, camera.intrinsics.height);
        let (columns, rows) = (width as usize, height as usize);
        let (fx, fy) = (camera.intrinsics.fx.abs(), camera.intrinsics.fy.abs());
        let view = View {
            camera,
            world_from_cam: world_from_cam.rotation_matrix(),
            origin: self.scene.to_local(world_from_cam.translation),
            spread: (1.0 / (fx * fy).sqrt()) as f32,
        };
        let blank = Sample { color: [0.0; 3], depth: f32::INFINITY, instance: 0, key: 0, semantic: SKY_LABEL };
        let mut samples = vec![blank; columns * rows];
        let first = |(row, line): (usize, &mut [Sample])| {
            for (column, sample) in line.iter_mut().enumerate() {
                *sample = self.center_sample(&view, column, row).unwrap_or(blank);
            }
        };
        for_rows(parallel, &mut samples, columns, first);
        let mut rgb = vec![0u8; columns * rows * 3];
        let second = |(row, line): (usize, &mut [u8])| {
            for (column, pixel) in line.chunks_exact_mut(3).enumerate() {
                let color = if options.samples_per_pixel > 1 && on_edge(&samples, columns, rows, column, row) {
                    self.smooth(&view, column, row, samples[row * columns + column].color, options.samples_per_pixel)
                } else {
                    samples[row * columns + column].color
                };
                for (byte, value) in pixel.iter_mut().zip(color) {
                    *byte = (value + 0.5) as u8;
                }
            }
        };
        for_rows(parallel, &mut rgb, columns * 3, second);
        Rendering {
            width,
            height,
            rgb,
            depth: samples.iter().map(|s| s.depth).collect(),
            semantic: samples.iter().map(|s| s.semantic).collect(),
            instance: samples.iter().map(|s| s.instance).collect(),
        }
    }

    fn center_sample(&self, view: &View, column: usize, row: usize) -> Option<Sample> {
        let pixel = DVec2::new(column as f64 + 0.5, row as f64 + 0.5);
        let in_cam = view.camera.unproject(pixel)?;
        let ray = Ray::new(view.origin, (view.world_from_cam * in_cam).as_vec3());
        let Some((t, met)) = self.trace(&ray, FAR_M) else {
            let color = self.scene.sky.display(self.scene.sky.seen(ray.direction));
            return Some(Sample { color, depth: f32::INFINITY, instance: 0, key: 0, semantic: SKY_LABEL });
        };
        let color = self.scene.sky.display(self.shade(&ray, t, met, view.spread));
        let (semantic, instance, key) = match self.body(met) {
            Some((_, surface)) => {
                let key = match met {
                    Met::Ground => 0,
                    Met::Static(index) => 16 + 2 * index,
                    Met::Mover(index) => 17 + 2 * index,
                };
                (surface.label, surface.instance, key)
            }
            None => {
                let cover = self.spot(ray.at(t)).cover;
                (cover.label(), 0, 1 + cover as u32)
            }
        };
        Some(Sample { color, depth: t * in_cam.z as f32, instance, key, semantic })
    }

    /// Mean of the centre's colour and further rays at fixed places in the pixel.
    fn smooth(&self, view: &View, column: usize, row: usize, center: [f32; 3], samples: u32) -> [f32; 3] {
        let mut sum = center;
        let mut count = 1.0;
        for i in 1..samples {
            // The R2 sequence (Roberts 2018) spreads any number of points evenly.
            let at = |step: f64| {
                let x = 0.5 + step * f64::from(i);
                x - x.floor()
            };
            let pixel =
                DVec2::new(column as f64 + at(0.754_877_666_246_692_7), row as f64 + at(0.569_840_290_998_053_3));
            let Some(in_cam) = view.camera.unproject(pixel) else { continue };
            let ray = Ray::new(view.origin, (view.world_from_cam * in_cam).as_vec3());
            let light = match self.trace(&ray, FAR_M) {
                Some((t, met)) => self.shade(&ray, t, met, view.spread),
                None => self.scene.sky.seen(ray.direction),
            };
            let color = self.scene.sky.display(light);
            sum = [sum[0] + color[0], sum[1] + color[1], sum[2] + color[2]];
            count += 1.0;
        }
        sum.map(|c| c / count)
    }
}

/// Whether a pixel's neighbours to the left, right, above or below see another surface.
fn on_edge(samples: &[Sample], columns: usize, rows: usize, column: usize, row: usize) -> bool {
    let key = samples[row * columns + column].key;
    let other = |c: usize, r: usize| samples[r * columns + c].key != key;
    (column > 0 && other(column - 1, row))
        || (column + 1 < columns && other(column + 1, row))
        || (row > 0 && other(column, row - 1))
        || (row + 1 < rows && other(column, row + 1))
}

/// Runs over rows, on all threads or on this one.
fn for_rows<T: Send>(parallel: bool, buffer: &mut [T], row: usize, work: impl Fn((usize, &mut [T])) + Sync + Send) {
    if parallel {
        buffer.par_chunks_mut(row).enumerate().for_each(work);
    } else {
        buffer.chunks_mut(row).enumerate().for_each(work);
    }
}

//! Fourier codes of positions, with which cameras, boxes and map elements become tokens.
//!
//! DualDiff+, equations 3 to 6, with the frequencies of cure-lab/MagicDrive: 1, 2, 4, 8, without a factor π.

use geometry::Rigid;
use geometry::glam::DMat3;

/// Numbers of the code of one 3-vector.
pub const FOURIER_WIDTH: usize = 27;

const FREQUENCIES: [f64; 4] = [1.0, 2.0, 4.0, 8.0];

/// The vector, then for each frequency f the sines and the cosines of f times it. Angles are those of the exact f32 values: entries of a
/// camera matrix are thousands of radians.
#[must_use]
pub fn fourier_code(vector: [f32; 3]) -> [f32; FOURIER_WIDTH] {
    let mut code = [0.0; FOURIER_WIDTH];
    let (own, waves) = code.split_at_mut(3);
    own.copy_from_slice(&vector);
    for (frequency, wave) in FREQUENCIES.iter().zip(waves.chunks_exact_mut(6)) {
        for (at, value) in vector.iter().enumerate() {
            let (sine, cosine) = (frequency * f64::from(*value)).sin_cos();
            wave[at] = sine as f32;
            wave[3 + at] = cosine as f32;
        }
    }
    code
}

/// The seven columns of `[K | R | t]`, each in its Fourier code: 189 numbers.
#[must_use]
pub fn camera_code(k: &DMat3, ego_from_cam: &Rigid) -> Vec<f32> {
    let turn = ego_from_cam.rotation_matrix();
    let columns = [k.x_axis, k.y_axis, k.z_axis, turn.x_axis, turn.y_axis, turn.z_axis, ego_from_cam.translation];
    columns.iter().flat_map(|column| fourier_code(column.to_array().map(|value| value as f32))).collect()
}

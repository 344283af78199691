//! The array of one latent file: its layout, told or declared.

use std::path::Path;

use serde::{Deserialize, Serialize};

use super::Latent;
use crate::DataError;
use crate::npz::{Dtype, Want, parse_npy};

/// How the array of a file is laid out.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum NpyLayout {
    /// `[h·w, C]`, row-major cells
    Tokens,
    /// `[C, h, w]`, or `[2C, h, w]`: means, then log variances
    Chw,
    /// `[h, w, C]`, or `[h, w, 2C]`
    Hwc,
    /// `[h·w, 2C]`: means, then log variances
    MomentsTokens,
}

impl NpyLayout {
    const ALL: [Self; 4] = [Self::Tokens, Self::Chw, Self::Hwc, Self::MomentsTokens];

    const fn name(self) -> &'static str {
        match self {
            Self::Tokens => "tokens",
            Self::Chw => "chw",
            Self::Hwc => "hwc",
            Self::MomentsTokens => "moments_tokens",
        }
    }

    /// Shapes of latents `[C, h, w]` in this layout, with the number of channels in the file.
    pub(super) fn shapes(self, [c, h, w]: [usize; 3]) -> Vec<(Vec<usize>, usize)> {
        match self {
            Self::Tokens => vec![(vec![h * w, c], c)],
            Self::MomentsTokens => vec![(vec![h * w, 2 * c], 2 * c)],
            Self::Chw => vec![(vec![c, h, w], c), (vec![2 * c, h, w], 2 * c)],
            Self::Hwc => vec![(vec![h, w, c], c), (vec![h, w, 2 * c], 2 * c)],
        }
    }

    /// Whether channels run fastest.
    pub(super) fn channels_last(self) -> bool {
        self != Self::Chw
    }
}

/// The latent of a file's bytes.
pub(super) fn parse(
    bytes: &[u8],
    path: &Path,
    shape: [usize; 3],
    declared: Option<NpyLayout>,
) -> Result<Latent, DataError> {
    let layouts = declared.map_or(NpyLayout::ALL.to_vec(), |layout| vec![layout]);
    let (mut fitting, mut refusal) = (Vec::new(), None);
    for layout in layouts {
        for (want, channels) in layout.shapes(shape) {
            let want: Vec<Option<usize>> = want.into_iter().map(Some).collect();
            match parse_npy(bytes, path, &Want { dtypes: &[Dtype::F16, Dtype::F32], shape: &want }) {
                Ok(array) => fitting.push((layout, channels, array)),
                Err(error @ DataError::Array { .. }) => refusal = Some(error),
                Err(error) => return Err(error),
            }
        }
    }
    let names = fitting.iter().map(|(layout, ..)| layout.name()).collect::<Vec<_>>();
    match (fitting.pop(), fitting.is_empty(), refusal) {
        (Some((layout, channels, array)), true, _) => {
            let values: Vec<f32> = array.to_f64().into_iter().map(|value| value as f32).collect();
            ordered(&values, layout, channels, shape).checked(shape, path)
        }
        (Some(_), false, _) => Err(DataError::Format {
            format: "latent",
            why: format!("its shape may be {}; declare `layout`", names.join(" or ")),
            path: path.to_owned(),
        }),
        (None, _, Some(error)) => Err(error),
        (None, _, None) => {
            Err(DataError::Format { format: "latent", why: "it has no array".to_owned(), path: path.to_owned() })
        }
    }
}

/// Means, and log variances where there are twice as many channels, as `[C, h, w]`.
fn ordered(values: &[f32], layout: NpyLayout, channels: usize, [c, h, w]: [usize; 3]) -> Latent {
    let cells = h * w;
    let plane = |channel: usize| -> Vec<f32> {
        if layout.channels_last() {
            values.iter().skip(channel).step_by(channels).copied().collect()
        } else {
            values.iter().skip(channel * cells).take(cells).copied().collect()
        }
    };
    let part = |from: usize| (from..from + c).flat_map(plane).collect::<Vec<f32>>();
    Latent { mean: part(0), log_var: (channels == 2 * c).then(|| part(c)) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::npz::npy_bytes;

    /// `[C, h, w]` = `[2, 3, 4]`: every number names its place.
    const SHAPE: [usize; 3] = [2, 3, 4];

    fn wanted(extra: f32) -> Vec<f32> {
        (0..24).map(|at| extra + at as f32).collect()
    }

    fn file(shape: &[usize], values: &[f32]) -> Vec<u8> {
        npy_bytes(Dtype::F32, shape, &values.iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<_>>()).unwrap()
    }

    fn channels_last(planes: &[f32]) -> Vec<f32> {
        (0..12).flat_map(|cell| planes.iter().skip(cell).step_by(12).copied().collect::<Vec<_>>()).collect()
    }

    #[test]
    fn every_layout_gives_the_same_latent() {
        let (mean, log_var) = (wanted(0.0), wanted(100.0));
        let both = [mean.clone(), log_var.clone()].concat();
        let path = Path::new("some.npy");
        for (shape, values, has_variance) in [
            (vec![12, 2], channels_last(&mean), false),
            (vec![2, 3, 4], mean.clone(), false),
            (vec![3, 4, 2], channels_last(&mean), false),
            (vec![12, 4], channels_last(&both), true),
            (vec![4, 3, 4], both.clone(), true),
            (vec![3, 4, 4], channels_last(&both), true),
        ] {
            let got = parse(&file(&shape, &values), path, SHAPE, None).unwrap();
            assert_eq!(got.mean, mean, "{shape:?}");
            assert_eq!(got.log_var, has_variance.then(|| log_var.clone()), "{shape:?}");
        }
    }

    #[test]
    fn ambiguous_shapes_must_be_declared_and_bad_numbers_are_named() {
        let path = Path::new("some.npy");
        let bytes = file(&[4, 4, 4], &(0..64).map(|at| at as f32).collect::<Vec<_>>());
        // Two channels over 4 x 4 cells: twice as many channels first or last.
        let error = parse(&bytes, path, [2, 4, 4], None).unwrap_err().to_string();
        assert!(error.contains("chw or hwc") && error.contains("some.npy"), "{error}");
        let first = parse(&bytes, path, [2, 4, 4], Some(NpyLayout::Chw)).unwrap();
        let last = parse(&bytes, path, [2, 4, 4], Some(NpyLayout::Hwc)).unwrap();
        assert_eq!((first.mean[1], last.mean[1]), (1.0, 4.0));
        let wrong = parse(&bytes, path, [3, 4, 4], None).unwrap_err().to_string();
        assert!(wrong.contains("some.npy") && wrong.contains("4, 4, 4"), "{wrong}");
        let nan =
            parse(&file(&[2, 1, 1], &[0.0, f32::NAN]), path, [2, 1, 1], Some(NpyLayout::Chw)).unwrap_err().to_string();
        assert!(nan.contains("number 1 is not finite"), "{nan}");
        let whole = npy_bytes(Dtype::I32, &[12, 2], &[0; 96]).unwrap();
        assert!(parse(&whole, path, SHAPE, None).is_err());
    }
}

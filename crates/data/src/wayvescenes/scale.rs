//! The metric scale: COLMAP's unit is arbitrary, the distances between the cameras on the car are published.

use std::collections::BTreeMap;
use std::path::Path;

use serde::{Deserialize, Serialize};

use crate::DataError;
use crate::store::StoredFile;

/// Largest share by which the scales that single cameras give may differ.
const MOST_SPREAD: f64 = 0.02;

/// Short names in the table of baselines.
const SHORT_NAMES: [(&str, &str); 5] = [
    ("ff", super::REFERENCE_CHANNEL),
    ("rf", "right-forward"),
    ("rb", "right-backward"),
    ("lb", "left-backward"),
    ("lf", "left-forward"),
];

/// Metres from the forward camera to the others, by region of the world the cars drive in and then by channel.
///
/// The file form is `{"us": {"dist_ff_to_rf_m": 0.85, ...}, ...}`; a channel without a short name stands there by its full name.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(transparent)]
pub(crate) struct Baselines(BTreeMap<String, BTreeMap<String, f64>>);

impl Baselines {
    /// The published numbers, <https://github.com/wayveai/wayve_scenes>, `data/baselines.json`.
    pub(crate) fn published() -> Self {
        let region = |distances: [f64; 4]| {
            let channels = ["right-forward", "left-forward", "right-backward", "left-backward"];
            channels.into_iter().map(key).zip(distances).collect::<BTreeMap<_, _>>()
        };
        let us = region([0.8498135660837616, 1.2965344797189158, 0.8704826549104813, 1.3173149482944464]);
        let uk = region([0.8897557029319904, 1.1594041361406298, 0.9240592032981437, 1.1934664181283023]);
        Self(BTreeMap::from([("us".to_owned(), us), ("uk".to_owned(), uk)]))
    }

    /// # Errors
    /// [`DataError::Json`] for another form and for distances that are none.
    pub(crate) fn read(file: &StoredFile) -> Result<Self, DataError> {
        let bad = |why: String| DataError::Json { why, path: file.path().to_owned() };
        let table: Self = serde_json::from_slice(&file.bytes()?).map_err(|error| bad(error.to_string()))?;
        for (region, distances) in &table.0 {
            if let Some((name, metres)) = distances.iter().find(|row| !(row.1.is_finite() && *row.1 >= 0.0)) {
                return Err(bad(format!("{region}.{name} is {metres}, which is no distance")));
            }
        }
        Ok(table)
    }

    /// Adds a region.
    pub(crate) fn insert(&mut self, region: &str, metres: &BTreeMap<String, f64>) {
        let row = metres.iter().map(|(channel, metres)| (key(channel), *metres)).collect();
        self.0.insert(region.to_owned(), row);
    }

    /// The region with these distances, to within a tolerance in metres.
    pub(crate) fn find(&self, metres: &BTreeMap<String, f64>, tolerance_m: f64) -> Option<&str> {
        let same = |row: &BTreeMap<String, f64>| {
            metres
                .iter()
                .all(|(channel, d)| row.get(&key(channel)).is_some_and(|known| (known - d).abs() < tolerance_m))
        };
        self.0.iter().find(|(_, row)| same(row)).map(|(region, _)| region.as_str())
    }

    /// Whether there is a region of this name.
    pub(crate) fn has(&self, region: &str) -> bool {
        self.0.contains_key(region)
    }
}

fn key(channel: &str) -> String {
    let short = SHORT_NAMES.iter().find(|(_, long)| *long == channel).map_or(channel, |(short, _)| short);
    format!("dist_ff_to_{short}_m")
}

/// A region's scale for one scene.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Fit {
    pub(crate) region: String,
    /// Metres per unit, the median over the cameras.
    pub(crate) metres_per_unit: f64,
    /// Largest minus smallest scale of the cameras, as a share of the median.
    pub(crate) spread: f64,
}

/// The scale of every region for the distances of the forward camera to the others in COLMAP units, best first.
pub(crate) fn fits(baselines: &Baselines, units: &BTreeMap<String, f64>) -> Vec<Fit> {
    let fit = |(region, metres): (&String, &BTreeMap<String, f64>)| {
        let known = units.iter().filter_map(|(channel, distance)| {
            let metres = metres.get(&key(channel)).filter(|metres| **metres > 0.0)?;
            (*distance > 0.0).then(|| metres / distance)
        });
        let mut scales: Vec<f64> = known.collect();
        scales.sort_by(f64::total_cmp);
        let metres_per_unit = median(&scales)?;
        let spread = (scales.last()? - scales.first()?) / metres_per_unit;
        Some(Fit { region: region.clone(), metres_per_unit, spread })
    };
    let mut fits: Vec<Fit> = baselines.0.iter().filter_map(fit).collect();
    fits.sort_by(|a, b| a.spread.total_cmp(&b.spread));
    fits
}

/// The scale of the region that fits.
///
/// # Errors
/// [`DataError::Format`], naming the COLMAP file, where no region fits within 2 %, and where two do that differ in scale.
pub(crate) fn choose(baselines: &Baselines, units: &BTreeMap<String, f64>, path: &Path) -> Result<Fit, DataError> {
    let bad = |why: String| DataError::Format { format: "WayveScenes101", why, path: path.to_owned() };
    let mut fits = fits(baselines, units).into_iter();
    let best = fits.next().ok_or_else(|| bad("no camera has a known baseline".to_owned()))?;
    if best.spread.is_nan() || best.spread > MOST_SPREAD {
        return Err(bad(format!(
            "the cameras disagree about the metric scale by {:.1} % with the baselines of {:?}, the best region",
            100.0 * best.spread,
            best.region
        )));
    }
    let rival = fits.find(|fit| {
        fit.spread <= MOST_SPREAD && (fit.metres_per_unit / best.metres_per_unit - 1.0).abs() > MOST_SPREAD
    });
    match rival {
        Some(rival) => Err(bad(format!(
            "the baselines of {:?} and {:?} both fit, with {} and {} metres per unit; set `scale`",
            best.region, rival.region, best.metres_per_unit, rival.metres_per_unit
        ))),
        None => Ok(best),
    }
}

/// The middle of sorted values, or the mean of the two middle ones.
pub(crate) fn median(sorted: &[f64]) -> Option<f64> {
    let upper = *sorted.get(sorted.len() / 2)?;
    let lower = *sorted.get((sorted.len() - 1) / 2)?;
    Some(0.5 * (lower + upper))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn units(scale: f64, distances: [f64; 4]) -> BTreeMap<String, f64> {
        let channels = ["right-forward", "left-forward", "right-backward", "left-backward"];
        channels.iter().map(|c| (*c).to_owned()).zip(distances.map(|d| d / scale)).collect()
    }

    const US: [f64; 4] = [0.849814, 1.296534, 0.870483, 1.317315];
    const UK: [f64; 4] = [0.889756, 1.159404, 0.924059, 1.193466];

    #[test]
    fn the_ratios_tell_the_regions_apart() {
        let table = Baselines::published();
        for (region, distances, scale) in [("us", US, 2.7), ("uk", UK, 0.384)] {
            let found = fits(&table, &units(scale, distances));
            assert_eq!(found[0].region, region);
            assert!((found[0].metres_per_unit / scale - 1.0).abs() < 1e-6 && found[0].spread < 1e-5);
            assert!(found[1].spread > 0.1, "the wrong region spreads by {}", found[1].spread);
            let chosen = choose(&table, &units(scale, distances), Path::new("images.bin")).unwrap();
            assert_eq!(chosen, found[0]);
        }
    }

    #[test]
    fn odd_rigs_and_ambiguous_rigs_are_refused() {
        let table = Baselines::published();
        let refuse = |units: &BTreeMap<String, f64>| {
            let error = choose(&table, units, Path::new("images.bin")).unwrap_err();
            assert!(matches!(error, DataError::Format { .. }) && error.to_string().ends_with("images.bin"));
            error.to_string()
        };
        assert!(refuse(&units(1.0, [1.0; 4])).contains("disagree"));
        assert!(refuse(&BTreeMap::from([("left-forward".to_owned(), 1.0)])).contains("both fit"));
        assert!(refuse(&BTreeMap::new()).contains("no camera"));
        assert!(refuse(&units(f64::NAN, US)).contains("no camera"));
    }

    #[test]
    fn tables_keep_their_file_form() {
        let mut table = Baselines::default();
        table.insert("us", &units(1.0, US));
        table.insert("rig_2", &BTreeMap::from([("CAM_BACK".to_owned(), 1.5)]));
        let text = serde_json::to_string(&table).unwrap();
        assert!(
            text.contains("\"dist_ff_to_CAM_BACK_m\":1.5") && text.contains("\"dist_ff_to_lb_m\":1.317315"),
            "{text}"
        );
        assert_eq!(serde_json::from_str::<Baselines>(&text).unwrap(), table);
        assert_eq!(Baselines::published().find(&units(1.0, UK), 1e-4), Some("uk"));
        assert_eq!(Baselines::published().find(&units(1.1, UK), 1e-4), None);
        assert!(table.has("rig_2") && !table.has("uk"));
    }
}

//! The combined score of the W-CODA challenge: DualDiff+, equation 15.

/// Values of the baseline, which scores 0.
const BASELINE_FVD: f64 = 218.12;
/// In percent.
const BASELINE_MAP: f64 = 11.8617;
/// In percent.
const BASELINE_MIOU: f64 = 18.3429;

/// Sum of the relative gains over the baseline: distance of videos (lower is better), detection and road segmentation on generated
/// pictures, both in percent.
#[must_use]
pub fn wcoda_score(fvd: f64, map_percent: f64, miou_percent: f64) -> f64 {
    (BASELINE_FVD - fvd) / BASELINE_FVD
        + (map_percent - BASELINE_MAP) / BASELINE_MAP
        + (miou_percent - BASELINE_MIOU) / BASELINE_MIOU
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn published_rows() {
        assert_eq!(wcoda_score(BASELINE_FVD, BASELINE_MAP, BASELINE_MIOU), 0.0);
        for (fvd, map, miou, score) in
            [(220.01, 13.32, 22.22, 0.33), (306.07, 13.29, 22.25, -0.07), (232.50, 12.78, 19.46, 0.07)]
        {
            assert!((wcoda_score(fvd, map, miou) - score).abs() < 0.005);
        }
    }
}

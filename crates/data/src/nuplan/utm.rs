//! Degrees to metres: the universal transverse Mercator projection on WGS 84.
//!
//! Krüger's series to the fourth order in the third flattening, as in Karney, "Transverse Mercator with an accuracy of a few nanometers",
//! Journal of Geodesy 85 (2011), equations 7 to 11 and 35. Within a zone it is right to much less than a millimetre.

use geometry::glam::DVec2;

/// Semi-major axis, metres, and flattening of the ellipsoid.
const SEMI_MAJOR_M: f64 = 6_378_137.0;
const FLATTENING: f64 = 1.0 / 298.257_223_563;
/// Scale on the central meridian.
const SCALE: f64 = 0.9996;
const FALSE_EASTING_M: f64 = 500_000.0;
const FALSE_NORTHING_M: f64 = 10_000_000.0;

/// A zone of one hemisphere.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Utm {
    central_meridian_rad: f64,
    false_northing_m: f64,
}

impl Utm {
    /// By number in the EPSG register: 326zz for zone zz north, 327zz for south. `None` for anything else.
    pub fn of_epsg(epsg: i64) -> Option<Self> {
        let (false_northing_m, zone) = match epsg {
            32_601..=32_660 => (0.0, epsg - 32_600),
            32_701..=32_760 => (FALSE_NORTHING_M, epsg - 32_700),
            _ => return None,
        };
        Some(Self { central_meridian_rad: (zone as f64 * 6.0 - 183.0).to_radians(), false_northing_m })
    }

    /// Easting and northing, metres, of longitude and latitude, degrees.
    pub fn project(&self, degrees: DVec2) -> DVec2 {
        let n = FLATTENING / (2.0 - FLATTENING);
        let rectifying_m = SEMI_MAJOR_M / (1.0 + n) * (1.0 + n.powi(2) / 4.0 + n.powi(4) / 64.0);
        let eccentricity = 2.0 * n.sqrt() / (1.0 + n);
        let (sin_latitude, longitude) =
            (degrees.y.to_radians().sin(), degrees.x.to_radians() - self.central_meridian_rad);
        let t = (sin_latitude.atanh() - eccentricity * (eccentricity * sin_latitude).atanh()).sinh();
        let (xi, eta) = (t.atan2(longitude.cos()), (longitude.sin() / t.hypot(longitude.cos())).asinh());
        let (mut easting, mut northing) = (eta, xi);
        for (order, factor) in series(n).into_iter().enumerate() {
            let multiple = 2.0 * (order as f64 + 1.0);
            easting += factor * (multiple * xi).cos() * (multiple * eta).sinh();
            northing += factor * (multiple * xi).sin() * (multiple * eta).cosh();
        }
        let metres = SCALE * rectifying_m;
        DVec2::new(FALSE_EASTING_M + metres * easting, self.false_northing_m + metres * northing)
    }
}

fn series(n: f64) -> [f64; 4] {
    [
        n / 2.0 - 2.0 / 3.0 * n.powi(2) + 5.0 / 16.0 * n.powi(3) + 41.0 / 180.0 * n.powi(4),
        13.0 / 48.0 * n.powi(2) - 3.0 / 5.0 * n.powi(3) + 557.0 / 1440.0 * n.powi(4),
        61.0 / 240.0 * n.powi(3) - 103.0 / 140.0 * n.powi(4),
        49561.0 / 161_280.0 * n.powi(4),
    ]
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Longitude, latitude, zone, easting, northing; from PROJ.
    const KNOWN: [(f64, f64, i64, f64, f64); 4] = [
        (-115.1728, 36.1147, 32_611, 664_450.975_062, 3_998_216.335_324),
        (-71.0589, 42.3601, 32_619, 330_448.106_479, 4_691_812.059_469),
        (103.79, 1.299, 32_648, 365_381.601_820, 143_611.005_070),
        (-58.3816, -34.6037, 32_721, 373_317.502_255, 6_170_036.171_295),
    ];

    #[test]
    fn metres_equal_those_of_proj() {
        for (longitude, latitude, epsg, easting, northing) in KNOWN {
            let got = Utm::of_epsg(epsg).unwrap().project(DVec2::new(longitude, latitude));
            assert!(got.distance(DVec2::new(easting, northing)) < 1e-4, "{got} for {longitude} {latitude}");
        }
        for none in [4326, 32_600, 32_661, 32_761, 3857] {
            assert!(Utm::of_epsg(none).is_none());
        }
    }
}

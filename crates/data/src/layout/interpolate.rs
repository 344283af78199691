//! Between two layouts.

use std::collections::BTreeMap;

use geometry::OrientedBox;

use super::{Layout, LayoutBox, LayoutError};

impl Layout {
    /// The layout `amount` of the way from this one (0) to `other` (1).
    ///
    /// A box of both is the same object where the tracks agree, or the ids where one has no track: its centre and size go straight, its
    /// rotation the short way round at constant speed. A box of one layout only is there for the half of the way that is nearer to that
    /// layout; so is the class of an object that changes it. The middle counts to `other`.
    ///
    /// # Errors
    /// [`LayoutError::Amount`] for an amount outside 0..=1; as [`Layout::check`].
    pub fn interpolate(&self, other: &Self, amount: f64) -> Result<Self, LayoutError> {
        if !(0.0..=1.0).contains(&amount) {
            return Err(LayoutError::Amount { amount });
        }
        self.check()?;
        other.check()?;
        let (near, far) = if amount < 0.5 { (self, other) } else { (other, self) };
        let partners = Partners::of(far);
        let boxes = near.boxes.iter().map(|found| {
            let Some(partner) = partners.find(found) else { return found.clone() };
            let (from, to) = if amount < 0.5 { (found, partner) } else { (partner, found) };
            LayoutBox { shape: between(&from.shape, &to.shape, amount), ..found.clone() }
        });
        Ok(Self { boxes: boxes.collect() })
    }
}

struct Partners<'a> {
    by_track: BTreeMap<&'a str, &'a LayoutBox>,
    by_id: BTreeMap<&'a str, &'a LayoutBox>,
}

impl<'a> Partners<'a> {
    fn of(layout: &'a Layout) -> Self {
        let by_track = layout.boxes.iter().filter_map(|found| Some((found.track.as_deref()?, found))).collect();
        Self { by_track, by_id: layout.boxes.iter().map(|found| (found.id.as_str(), found)).collect() }
    }

    fn find(&self, found: &LayoutBox) -> Option<&'a LayoutBox> {
        let of_track = found.track.as_deref().and_then(|track| self.by_track.get(track));
        let of_id = || self.by_id.get(found.id.as_str()).filter(|other| found.track.is_none() || other.track.is_none());
        of_track.or_else(of_id).copied()
    }
}

fn between(from: &OrientedBox, to: &OrientedBox, amount: f64) -> OrientedBox {
    let pose = from.dst_from_box().interpolate(&to.dst_from_box(), amount);
    OrientedBox { center: pose.translation, rotation: pose.rotation, size: from.size.lerp(to.size, amount) }
}

#[cfg(test)]
mod tests {
    use geometry::Box3d;
    use geometry::glam::DVec3;

    use super::*;

    fn named(id: &str, track: Option<&str>, x: f64, yaw: f64) -> LayoutBox {
        let shape = Box3d { center: DVec3::new(x, 0.0, 0.0), size: DVec3::new(4.0, 2.0, 1.0 + x), yaw };
        LayoutBox { track: track.map(str::to_owned), ..LayoutBox::new(id, "car", shape) }
    }

    #[test]
    fn centres_and_sizes_go_straight_and_headings_the_short_way() {
        let (a, b) =
            (Layout { boxes: vec![named("a", None, 0.0, 3.0)] }, Layout { boxes: vec![named("a", None, 8.0, -3.0)] });
        for amount in [0.0, 0.25, 0.5, 0.75, 1.0] {
            let mixed = a.interpolate(&b, amount).unwrap().boxes[0].shape;
            assert!((mixed.center.x - 8.0 * amount).abs() < 1e-12);
            assert!((mixed.size.z - 1.0 - 8.0 * amount).abs() < 1e-12);
            let turned = geometry::wrap_angle(mixed.upright().yaw - 3.0);
            let whole = std::f64::consts::TAU - 6.0;
            assert!((turned - whole * amount).abs() < 1e-9, "{turned} at {amount}");
        }
        assert_eq!(a.interpolate(&b, 0.0).unwrap(), a);
    }

    #[test]
    fn objects_are_known_by_track_and_else_by_id() {
        let a = Layout { boxes: vec![named("car-1", Some("x"), 0.0, 0.0), named("car-2", None, 10.0, 0.0)] };
        let b = Layout { boxes: vec![named("car-1", Some("y"), 4.0, 0.0), named("car-2", Some("x"), 8.0, 0.0)] };
        let at = |amount| {
            let mixed = a.interpolate(&b, amount).unwrap();
            mixed.boxes.iter().map(|found| (found.id.clone(), found.shape.center.x)).collect::<Vec<_>>()
        };
        // x is car-1, then car-2; y begins at the middle; a's car-2 has no track, so its id counts.
        assert_eq!(at(0.25), [("car-1".to_owned(), 2.0), ("car-2".to_owned(), 9.5)]);
        assert_eq!(at(0.5), [("car-1".to_owned(), 4.0), ("car-2".to_owned(), 4.0)]);
    }

    #[test]
    fn what_only_one_layout_has_is_there_for_its_half() {
        let a = Layout { boxes: vec![named("left", None, 1.0, 0.0)] };
        let b = Layout { boxes: vec![named("right", None, 2.0, 0.0)] };
        assert_eq!(a.interpolate(&b, 0.49).unwrap(), a);
        assert_eq!(a.interpolate(&b, 0.5).unwrap(), b);
        for amount in [-0.1, 1.1, f64::NAN] {
            assert!(matches!(a.interpolate(&b, amount), Err(LayoutError::Amount { .. })));
        }
    }
}

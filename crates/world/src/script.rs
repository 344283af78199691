//! How actors move: closed forms of time, so that any instant can be asked for.

use geometry::{Box3d, wrap_angle};
use glam::{DVec2, DVec3};

use crate::ActorState;
use crate::actor::ActorClass;
use crate::math::sin_cos;
use crate::network::Network;

/// Distance driven as a function of time: a mean speed with a slow swing.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Profile {
    /// Mean speed, m/s.
    pub speed: f64,
    /// Amplitude of the swing, m/s; below `speed`.
    pub swing: f64,
    /// Angular rate of the swing, rad/s.
    pub rate: f64,
    /// Phase of the swing at time 0.
    pub phase: f64,
}

impl Profile {
    /// Metres driven since time 0.
    pub fn distance(&self, time_secs: f64) -> f64 {
        let (_, start) = sin_cos(self.phase);
        let (_, now) = sin_cos(self.phase + self.rate * time_secs);
        self.speed * time_secs + self.swing / self.rate * (start - now)
    }

    /// Speed at a time.
    pub fn speed_at(&self, time_secs: f64) -> f64 {
        self.speed + self.swing * sin_cos(self.phase + self.rate * time_secs).0
    }
}

/// What an actor does.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Motion {
    /// Stays where it is.
    Still {
        /// Centre on the ground.
        point: DVec2,
        /// Heading.
        yaw: f64,
    },
    /// Follows a road at a constant offset; exists while it is between the road's ends.
    Follow {
        /// Index of the road.
        road: usize,
        /// Offset to the left of the road's axis.
        d: f64,
        /// +1 along the axis, -1 against it.
        direction: f64,
        /// Arc length at time 0.
        start_s: f64,
        /// Distance over time.
        profile: Profile,
    },
    /// Waits beside a road, crosses it, and stays on the other side.
    Cross {
        /// Index of the road.
        road: usize,
        /// Arc length of the crossing.
        s: f64,
        /// Offset where it waits and where it arrives.
        d: [f64; 2],
        /// Start of the walk.
        start_secs: f64,
        /// Walking speed.
        speed: f64,
    },
}

/// Where an actor is at one instant.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Place {
    /// Centre on the ground.
    pub point: DVec2,
    /// Heading.
    pub yaw: f64,
    /// Velocity over ground.
    pub velocity: DVec2,
    /// Metres moved since time 0; drives the gait.
    pub travelled: f64,
}

impl Motion {
    /// Whether it never moves.
    pub fn is_still(&self) -> bool {
        matches!(self, Self::Still { .. })
    }

    /// Where it is; `None` before it appears and after it has left.
    pub fn at(&self, network: &Network, time_secs: f64) -> Option<Place> {
        match *self {
            Self::Still { point, yaw } => Some(Place { point, yaw, velocity: DVec2::ZERO, travelled: 0.0 }),
            Self::Follow { road, d, direction, start_s, profile } => {
                let curve = &network.roads[road].curve;
                let travelled = profile.distance(time_secs);
                let s = start_s + direction * travelled;
                if s < 1.0 || s > curve.length() - 1.0 {
                    return None;
                }
                let station = curve.at(s);
                // A metre of axis is (1 - curvature d) metres at offset d.
                let speed = direction * profile.speed_at(time_secs) * (1.0 - station.curvature * d);
                let yaw = if direction > 0.0 { station.heading } else { station.heading + std::f64::consts::PI };
                Some(Place { point: station.offset(d), yaw, velocity: station.tangent * speed, travelled })
            }
            Self::Cross { road, s, d, start_secs, speed } => {
                let station = network.roads[road].curve.at(s);
                let (length, sign) = ((d[1] - d[0]).abs(), (d[1] - d[0]).signum());
                let travelled = (speed * (time_secs - start_secs)).clamp(0.0, length);
                let walking = travelled > 0.0 && travelled < length;
                let velocity = if walking { station.normal() * (sign * speed) } else { DVec2::ZERO };
                let yaw = station.heading + sign * std::f64::consts::FRAC_PI_2;
                Some(Place { point: station.offset(d[0] + sign * travelled), yaw, velocity, travelled })
            }
        }
    }
}

/// How an actor looks within its class.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Style {
    /// Variant within the class.
    pub variant: u8,
    /// Paint or clothes, linear.
    pub color: glam::Vec3,
    /// Second colour.
    pub accent: glam::Vec3,
    /// Makes equal actors differ.
    pub salt: u32,
}

/// One actor with its script.
#[derive(Debug, Clone, PartialEq)]
pub struct Actor {
    /// Identity.
    pub id: u32,
    /// Kind.
    pub class: ActorClass,
    /// Length, width, height.
    pub size: DVec3,
    /// What it does.
    pub motion: Motion,
    /// Parked for the whole scene.
    pub parked: bool,
    /// A rider sits on it.
    pub with_rider: bool,
    /// Looks.
    pub style: Style,
}

impl Actor {
    /// The public state at a place.
    pub fn state(&self, place: &Place) -> ActorState {
        let center = place.point.extend(self.size.z * 0.5);
        ActorState {
            id: self.id,
            class: self.class,
            world_box: Box3d { center, size: self.size, yaw: wrap_angle(place.yaw) },
            velocity: place.velocity,
            parked: self.parked,
            with_rider: self.with_rider,
        }
    }
}

/// A rectangle on the ground: centre, heading, half length and half width.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Footprint {
    /// Centre.
    pub center: DVec2,
    /// Unit vector along its length.
    pub forward: DVec2,
    /// Half length, half width.
    pub half: DVec2,
}

impl Footprint {
    /// From a centre, a heading and full sizes.
    pub fn new(center: DVec2, yaw: f64, length: f64, width: f64) -> Self {
        let (sin, cos) = sin_cos(yaw);
        Self { center, forward: DVec2::new(cos, sin), half: DVec2::new(length, width) * 0.5 }
    }

    /// The four corners.
    pub fn corners(&self) -> [DVec2; 4] {
        let (x, y) = (self.forward * self.half.x, self.forward.perp() * self.half.y);
        [self.center + x + y, self.center - x + y, self.center - x - y, self.center + x - y]
    }

    /// Whether two rectangles come closer than `margin` (separating axes; exact up to the corners of the margin).
    pub fn overlaps(&self, other: &Self, margin: f64) -> bool {
        let between = other.center - self.center;
        let reach = self.half.length() + other.half.length() + margin;
        if between.length_squared() > reach * reach {
            return false;
        }
        let extent =
            |f: &Self, axis: DVec2| f.half.x * f.forward.dot(axis).abs() + f.half.y * f.forward.perp().dot(axis).abs();
        [self.forward, self.forward.perp(), other.forward, other.forward.perp()]
            .into_iter()
            .all(|axis| between.dot(axis).abs() < extent(self, axis) + extent(other, axis) + margin)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn distance_integrates_speed() {
        let profile = Profile { speed: 8.0, swing: 2.0, rate: 0.4, phase: 1.0 };
        assert_eq!(profile.distance(0.0), 0.0);
        for i in 0..40 {
            let t = f64::from(i) * 0.5;
            let slope = (profile.distance(t + 1e-5) - profile.distance(t - 1e-5)) / 2e-5;
            assert!((slope - profile.speed_at(t)).abs() < 1e-5);
        }
    }

    #[test]
    fn footprints_overlap_as_drawn() {
        let a = Footprint::new(DVec2::ZERO, 0.0, 4.0, 2.0);
        assert!(a.overlaps(&Footprint::new(DVec2::new(3.0, 0.0), 0.0, 4.0, 2.0), 0.0));
        assert!(!a.overlaps(&Footprint::new(DVec2::new(0.0, 2.5), 0.0, 4.0, 2.0), 0.0));
        assert!(a.overlaps(&Footprint::new(DVec2::new(0.0, 2.5), 0.0, 4.0, 2.0), 0.6));
        assert!(a.overlaps(&Footprint::new(DVec2::new(0.0, 2.5), std::f64::consts::FRAC_PI_2, 4.0, 2.0), 0.0));
    }
}

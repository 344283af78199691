//! The list of all actors of a world, and the rule that no two of them may touch.

use glam::DVec3;

use crate::fleet::Model;
use crate::network::Network;
use crate::script::{Actor, Footprint, Motion, Profile};

/// Step at which paths are checked against each other. At 28 m/s closing speed a car moves its own length in it.
const CHECK_SECS: f64 = 0.15;
/// Actors that never come this close to the ego are dropped.
const REACH_M: f64 = 130.0;
/// The ego's body: length, width, height and how far its centre lies before the rear axle (a small hatchback).
pub const EGO_SIZE: DVec3 = DVec3::new(4.08, 1.73, 1.56);
/// Distance from the rear axle to the box centre.
pub const EGO_CENTER_M: f64 = 1.3;

/// Actors accepted so far.
pub struct Cast<'a> {
    network: &'a Network,
    ego: Motion,
    /// Accepted actors, ids in order.
    pub actors: Vec<Actor>,
    ego_track: Vec<Footprint>,
    tracks: Vec<Vec<Option<Footprint>>>,
}

impl<'a> Cast<'a> {
    /// An empty cast; `ego` is the motion of the ego's rear axle.
    pub fn new(network: &'a Network, ego: Motion, duration_secs: f64) -> Self {
        let steps = (duration_secs / CHECK_SECS).ceil() as usize;
        let ego_track = (0..=steps)
            .filter_map(|i| {
                let place = ego.at(network, i as f64 * CHECK_SECS)?;
                let footprint = Footprint::new(place.point, place.yaw, EGO_SIZE.x, EGO_SIZE.y);
                Some(Footprint { center: footprint.center + footprint.forward * EGO_CENTER_M, ..footprint })
            })
            .collect();
        Self { network, ego, actors: Vec::new(), ego_track, tracks: Vec::new() }
    }

    /// The network it plays on.
    pub fn network(&self) -> &'a Network {
        self.network
    }

    /// Speed profile of the ego.
    pub fn ego_profile(&self) -> Profile {
        match self.ego {
            Motion::Follow { profile, .. } => profile,
            _ => Profile { speed: 0.0, swing: 0.0, rate: 1.0, phase: 0.0 },
        }
    }

    /// Arc length of the ego's rear axle at the start and at the end.
    pub fn ego_range(&self) -> [f64; 2] {
        let start = self.network.ego_start_s;
        let last = self.ego_track.len().saturating_sub(1) as f64 * CHECK_SECS;
        [start, start + self.ego_profile().distance(last)]
    }

    /// Takes an actor in unless it would touch the ego or another actor at some time, or never comes near.
    pub fn add(&mut self, model: Model, motion: Motion, parked: bool) -> bool {
        let footprint = |time: f64| {
            let place = motion.at(self.network, time)?;
            Some(Footprint::new(place.point, place.yaw, model.size.x, model.size.y))
        };
        // A still actor's track has one entry.
        let count = if motion.is_still() { 1 } else { self.ego_track.len() };
        let track: Vec<_> = (0..count).map(|i| footprint(i as f64 * CHECK_SECS)).collect();
        if !self.comes_near(&track) || self.touches(&track) {
            return false;
        }
        self.actors.push(Actor {
            id: self.actors.len() as u32,
            class: model.class,
            size: model.size,
            motion,
            parked,
            with_rider: model.with_rider,
            style: model.style,
        });
        self.tracks.push(track);
        true
    }

    fn comes_near(&self, track: &[Option<Footprint>]) -> bool {
        self.ego_track
            .iter()
            .enumerate()
            .step_by(8)
            .any(|(i, ego)| at(track, i).is_some_and(|f| (f.center - ego.center).length_squared() < REACH_M * REACH_M))
    }

    fn touches(&self, track: &[Option<Footprint>]) -> bool {
        let hits_ego =
            self.ego_track.iter().enumerate().any(|(i, ego)| at(track, i).is_some_and(|f| f.overlaps(ego, 0.45)));
        hits_ego
            || self.tracks.iter().any(|other| {
                (0..track.len().max(other.len())).any(|i| match (at(track, i), at(other, i)) {
                    (Some(a), Some(b)) => a.overlaps(&b, 0.12),
                    _ => false,
                })
            })
    }
}

fn at(track: &[Option<Footprint>], index: usize) -> Option<Footprint> {
    if let [only] = track { *only } else { track[index] }
}

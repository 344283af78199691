//! The CAN bus expansion: what the vehicle measured about itself, per scene and message, beside the tables.

use std::collections::BTreeMap;

use geometry::Rigid;
use geometry::glam::{DQuat, DVec3};
use serde::de::DeserializeOwned;
use serde_json::Value;

use crate::DataError;
use crate::store::{Store, checked_name};

/// Scenes without messages, by number: the car's bus was not recorded or belongs to another scene.
const WITHOUT: [std::ops::RangeInclusive<u32>; 3] = [161..=168, 170..=176, 309..=314];
/// Names of fields that hold rotations as w, x, y, z.
const ROTATIONS: [&str; 2] = ["orientation", "q"];
/// Longest time between two messages that are interpolated, for messages of 50 Hz and more.
const FAST_GAP_NS: i64 = 100_000_000;
/// The same for the vehicle monitor, which comes at 2 Hz.
const SLOW_GAP_NS: i64 = 1_000_000_000;

/// Kinds of messages.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[allow(missing_docs, reason = "the names are the files'")]
pub enum CanMessage {
    Pose,
    MsImu,
    SteerAngleFeedback,
    VehicleMonitor,
    ZoeSensors,
    ZoeVehInfo,
}

impl CanMessage {
    /// As in the files' names.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Pose => "pose",
            Self::MsImu => "ms_imu",
            Self::SteerAngleFeedback => "steeranglefeedback",
            Self::VehicleMonitor => "vehicle_monitor",
            Self::ZoeSensors => "zoesensors",
            Self::ZoeVehInfo => "zoe_veh_info",
        }
    }

    const fn longest_gap_ns(self) -> i64 {
        match self {
            Self::VehicleMonitor => SLOW_GAP_NS,
            _ => FAST_GAP_NS,
        }
    }
}

/// What the vehicle measured at one instant, interpolated. A value is `None` where no two messages around the instant lie close enough
/// together: 0.1 s, for the vehicle monitor 1 s.
#[derive(Debug, Clone, PartialEq)]
pub struct CanState {
    /// The instant.
    pub timestamp_ns: i64,
    /// Position and orientation in the map's frame.
    pub world_from_ego: Option<Rigid>,
    /// m/s, ego axes.
    pub velocity: Option<[f64; 3]>,
    /// m/s², ego axes, gravity included.
    pub acceleration: Option<[f64; 3]>,
    /// rad/s, ego axes.
    pub rotation_rate: Option<[f64; 3]>,
    /// Angle of the steering wheel, rad, positive to the left.
    pub steering_rad: Option<f64>,
    /// Speed the vehicle shows, m/s.
    pub speed: Option<f64>,
    /// Yaw rate the vehicle shows, rad/s.
    pub yaw_rate: Option<f64>,
}

/// The messages of a scene.
#[derive(Debug, Clone)]
pub struct CanBus {
    store: Store,
    scene: String,
}

/// The messages of one kind, ascending in time.
#[derive(Debug, Clone, PartialEq)]
pub struct CanSignal {
    longest_gap_ns: i64,
    times_ns: Vec<i64>,
    rows: Vec<BTreeMap<String, Vec<f64>>>,
}

impl CanBus {
    /// `None` for a scene that is known to have none. Opens no file.
    ///
    /// # Errors
    /// [`DataError::UnsafePath`] for a scene's name that is no plain name.
    pub(super) fn of_scene(store: &Store, scene: &str) -> Result<Option<Self>, DataError> {
        checked_name(scene, &store.path("can_bus"))?;
        let number = scene.strip_prefix("scene-").and_then(|number| number.parse().ok());
        if number.is_some_and(|number: u32| WITHOUT.iter().any(|scenes| scenes.contains(&number))) {
            return Ok(None);
        }
        Ok(Some(Self { store: store.clone(), scene: scene.to_owned() }))
    }

    /// The messages of a kind.
    ///
    /// # Errors
    /// [`DataError::Missing`] where the scene lacks them, [`DataError::Json`] for a file that is not as it should be.
    pub fn signal(&self, message: CanMessage) -> Result<CanSignal, DataError> {
        let rows: Vec<BTreeMap<String, Value>> = self.json(message.name())?;
        let bad = |row: usize, why: &str| self.bad(message.name(), format!("row {row} {why}"));
        let mut parsed = Vec::new();
        for (at, row) in rows.into_iter().enumerate() {
            let time = row.get("utime").and_then(Value::as_i64).and_then(|time| time.checked_mul(1000));
            let time = time.ok_or_else(|| bad(at, "has no utime in microseconds"))?;
            let fields = row.into_iter().filter(|(name, _)| name != "utime");
            let numbers = |(name, value)| match numbers(&value) {
                Some(values) => Ok((name, values)),
                None => Err(bad(at, &format!("holds no numbers in {name}"))),
            };
            parsed.push((time, fields.map(numbers).collect::<Result<BTreeMap<_, _>, _>>()?));
        }
        // Messages are logged as they arrive, some twice.
        parsed.sort_by_key(|row| row.0);
        parsed.dedup_by_key(|row| row.0);
        let (times_ns, rows) = parsed.into_iter().unzip();
        Ok(CanSignal { longest_gap_ns: message.longest_gap_ns(), times_ns, rows })
    }

    /// The planned way, x and y in the map's frame, metres.
    ///
    /// # Errors
    /// As [`CanBus::signal`]; a few scenes have no route.
    pub fn route(&self) -> Result<Vec<[f64; 2]>, DataError> {
        self.json("route")
    }

    /// Statistics of the messages, as written.
    ///
    /// # Errors
    /// As [`CanBus::signal`].
    pub fn meta(&self) -> Result<serde_json::Map<String, Value>, DataError> {
        self.json("meta")
    }

    /// Everything measured at an instant.
    ///
    /// # Errors
    /// As [`CanBus::signal`], except that a missing vehicle monitor or steering file leaves its values out.
    pub fn state(&self, timestamp_ns: i64) -> Result<CanState, DataError> {
        let pose = self.signal(CanMessage::Pose)?;
        let optional = |message| match self.signal(message) {
            Ok(signal) => Ok(Some(signal)),
            Err(DataError::Missing { .. }) => Ok(None),
            Err(error) => Err(error),
        };
        let (steering, monitor) = (optional(CanMessage::SteerAngleFeedback)?, optional(CanMessage::VehicleMonitor)?);
        let triple = |name: &str| pose.at(timestamp_ns, name).and_then(|values| <[f64; 3]>::try_from(values).ok());
        let single = |signal: &Option<CanSignal>, name: &str| signal.as_ref()?.at(timestamp_ns, name)?.first().copied();
        let rotation = pose.at(timestamp_ns, "orientation").and_then(|values| <[f64; 4]>::try_from(values).ok());
        let world_from_ego = rotation.zip(triple("pos")).map(|([w, x, y, z], position)| Rigid {
            rotation: DQuat::from_xyzw(x, y, z, w),
            translation: DVec3::from_array(position),
        });
        Ok(CanState {
            timestamp_ns,
            world_from_ego,
            velocity: triple("vel"),
            acceleration: triple("accel"),
            rotation_rate: triple("rotation_rate"),
            steering_rad: single(&steering, "value"),
            // The monitor's own units are km/h and degrees.
            speed: single(&monitor, "vehicle_speed").map(|speed| speed / 3.6),
            yaw_rate: single(&monitor, "yaw_rate").map(f64::to_radians),
        })
    }

    fn name(&self, part: &str) -> String {
        format!("can_bus/{}_{part}.json", self.scene)
    }

    fn bad(&self, part: &str, why: String) -> DataError {
        DataError::Json { why, path: self.store.path(&self.name(part)) }
    }

    fn json<T: DeserializeOwned>(&self, part: &str) -> Result<T, DataError> {
        let bytes = self.store.read(&self.name(part), "CAN bus messages")?;
        serde_json::from_slice(&bytes).map_err(|error| self.bad(part, error.to_string()))
    }
}

/// A number or a list of numbers.
fn numbers(value: &Value) -> Option<Vec<f64>> {
    match value {
        Value::Array(values) => values.iter().map(Value::as_f64).collect(),
        Value::Bool(value) => Some(vec![f64::from(u8::from(*value))]),
        value => Some(vec![value.as_f64()?]),
    }
}

impl CanSignal {
    /// Stamps of the messages.
    pub fn times_ns(&self) -> &[i64] {
        &self.times_ns
    }

    /// The fields of a message; a plain number is a list of one.
    pub fn row(&self, at: usize) -> Option<&BTreeMap<String, Vec<f64>>> {
        self.rows.get(at)
    }

    /// A field at an instant: rotations on the shortest arc, everything else linearly. `None` outside the messages' time, in gaps and for
    /// fields that the messages around do not both have.
    pub fn at(&self, timestamp_ns: i64, field: &str) -> Option<Vec<f64>> {
        let next = self.times_ns.partition_point(|time| *time < timestamp_ns);
        let value = |at: usize| self.rows.get(at).and_then(|row| row.get(field));
        if self.times_ns.get(next) == Some(&timestamp_ns) {
            return value(next).cloned();
        }
        let before = next.checked_sub(1)?;
        let (start, end) = (*self.times_ns.get(before)?, *self.times_ns.get(next)?);
        let (a, b) = (value(before)?, value(next)?);
        if end.checked_sub(start)? > self.longest_gap_ns || a.len() != b.len() {
            return None;
        }
        let amount = (timestamp_ns - start) as f64 / (end - start) as f64;
        if ROTATIONS.contains(&field) {
            return between_rotations(a, b, amount);
        }
        Some(a.iter().zip(b).map(|(a, b)| a + (b - a) * amount).collect())
    }
}

fn between_rotations(a: &[f64], b: &[f64], amount: f64) -> Option<Vec<f64>> {
    let rotation = |values: &[f64]| Rigid::from_wxyz(values.try_into().ok()?, [0.0; 3]).ok();
    Some(rotation(a)?.interpolate(&rotation(b)?, amount).wxyz().to_vec())
}

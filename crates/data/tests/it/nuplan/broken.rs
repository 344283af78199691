//! Sound databases with one thing changed: what must still load, and what must be refused by name.

use std::time::{Duration, Instant};

use data::nuplan::{NuPlan, NuPlanConfig, check};
use data::taxonomy::ClassRule;
use data::{DataError, SceneDataset, SceneFrame};
use pickle::{encode_floats, encode_rows};
use rand::{RngExt, SeedableRng};

use super::made::Made;
use super::{frames, open, variant};

/// Opens the dataset and reads every frame.
fn read_everything(config: &NuPlanConfig) -> Result<Vec<SceneFrame>, DataError> {
    let dataset = NuPlan::open(config)?;
    (0..dataset.len()).map(|index| dataset.frame(index)).collect()
}

fn refused(made: &Made, want: &str, text: &str) {
    let error = read_everything(&made.config()).unwrap_err();
    let shown = error.to_string();
    assert_eq!(variant(&error), want, "{shown}");
    assert!(shown.contains(text), "{shown:?} does not mention {text:?}");
    assert!(want == "UnknownClass" || shown.ends_with("scene-0000.db"), "{shown}");
}

#[test]
fn changes_of_tables_are_refused_by_name() {
    for (sql, want, text) in [
        ("DROP TABLE camera", "Format", "no table camera"),
        ("DROP TABLE ego_pose", "Format", "no table ego_pose"),
        ("DROP TABLE track", "Format", "no table track"),
        ("ALTER TABLE ego_pose DROP COLUMN qz", "Column", "ego_pose.qz: does not exist"),
        ("ALTER TABLE lidar_box DROP COLUMN yaw", "Column", "lidar_box.yaw"),
        ("ALTER TABLE ego_pose DROP COLUMN x; ALTER TABLE ego_pose ADD COLUMN x AS (664000.0)", "Column", "computed"),
        ("ALTER TABLE image RENAME TO i; CREATE VIEW image AS SELECT * FROM i", "Format", "image is no plain table"),
        (
            "DROP TABLE image; CREATE VIEW image AS WITH RECURSIVE r(n) AS (SELECT 1 UNION ALL SELECT n + 1 FROM r) SELECT n AS token FROM r",
            "Format",
            "image is no plain table",
        ),
        ("UPDATE image SET timestamp = 'noon'", "Column", "image.timestamp"),
        ("UPDATE image SET timestamp = NULL", "Column", "image.timestamp"),
        ("UPDATE image SET timestamp = 9223372036854775807", "Column", "image.timestamp"),
        ("UPDATE image SET filename_jpg = '/etc/passwd'", "UnsafePath", "/etc/passwd"),
        ("UPDATE image SET filename_jpg = NULL", "Column", "image.filename_jpg"),
        ("UPDATE image SET token = x'01020304050607' || substr(token, 8)", "Column", "image.token"),
        ("UPDATE image SET camera_token = x'0102030405060708'", "Dangling", "camera_token"),
        ("UPDATE ego_pose SET z = NULL", "Column", "ego_pose.z"),
        ("UPDATE ego_pose SET x = 9e999", "Calibration", "not finite"),
        ("UPDATE ego_pose SET qw = 2.0", "Calibration", "norm"),
        ("UPDATE camera SET channel = 'CAM_F0'", "Format", "CAM_F0 occurs twice"),
        ("UPDATE camera SET channel = x'ff'", "Column", "camera.channel"),
        ("UPDATE camera SET width = 0", "Calibration", "width"),
        ("UPDATE camera SET width = 63.5", "Column", "camera.width"),
        ("UPDATE camera SET height = -36", "Column", "camera.height"),
        ("UPDATE camera SET intrinsic = 'x'", "Column", "camera.intrinsic"),
        ("UPDATE lidar_box SET length = -1.0", "Annotation", "[-1.0"),
        ("UPDATE lidar_box SET yaw = 9e999", "Annotation", "not finite"),
        ("UPDATE lidar_box SET vx = -9e999", "Annotation", "velocity"),
        ("UPDATE lidar_box SET x = NULL", "Column", "lidar_box.x"),
        ("UPDATE lidar_box SET track_token = x'0102030405060708'", "Dangling", "track_token"),
        ("UPDATE track SET category_token = x'0102030405060708'", "Dangling", "category_token"),
        ("UPDATE category SET name = 'HOVERBOARD' WHERE name = 'vehicle'", "UnknownClass", "HOVERBOARD"),
        (
            "DELETE FROM ego_pose WHERE timestamp > (SELECT min(timestamp) FROM ego_pose) AND timestamp < (SELECT max(timestamp) FROM ego_pose); \
             UPDATE ego_pose SET timestamp = timestamp - 1 WHERE timestamp = (SELECT min(timestamp) FROM ego_pose)",
            "Calibration",
            "further apart",
        ),
        ("DELETE FROM ego_pose", "Calibration", "no poses"),
        ("UPDATE ego_pose SET timestamp = timestamp + 60000000", "Calibration", "poses cover"),
    ] {
        let made = Made::new();
        made.change(sql);
        refused(&made, want, text);
    }
}

#[test]
fn calibration_of_wrong_shape_or_value_is_refused() {
    let rows = |k: [[f64; 3]; 3]| encode_rows(&k.each_ref().map(|row| row.as_slice()));
    let k = [[50.0, 0.0, 32.0], [0.0, 50.0, 18.0], [0.0, 0.0, 1.0]];
    let with = |row: usize, column: usize, value: f64| {
        let mut changed = k;
        changed[row][column] = value;
        rows(changed)
    };
    for (column, bytes, want, text) in [
        ("rotation", encode_floats(&[2.0, 0.0, 0.0, 0.0]), "Calibration", "norm"),
        ("rotation", encode_floats(&[0.0; 4]), "Calibration", "norm"),
        ("rotation", encode_rows(&[&[1.0, 0.0], &[0.0, 1.0]]), "Array", "not 4 numbers"),
        ("translation", encode_floats(&[f64::NAN, 0.0, 0.0]), "Calibration", "not finite"),
        ("translation", encode_floats(&[0.0; 4]), "Array", "a list of 4, not 3 numbers"),
        ("intrinsic", encode_floats(&[50.0; 9]), "Array", "3 rows of 3"),
        ("intrinsic", with(0, 0, 0.0), "Calibration", "positive"),
        ("intrinsic", with(1, 1, f64::INFINITY), "Calibration", "not finite"),
        ("intrinsic", with(0, 1, 0.1), "Column", "skew"),
        ("intrinsic", with(2, 2, 2.0), "Column", "skew"),
        ("distortion", encode_floats(&[0.1; 4]), "Array", "5 numbers"),
        ("distortion", encode_floats(&[0.1, 0.0, 0.0, 0.0, f64::NAN]), "Calibration", "not finite"),
        ("distortion", b"\x80\x04N.".to_vec(), "Array", "None"),
        ("distortion", b"".to_vec(), "Format", "pickle"),
        ("distortion", b"\x80\x02cnumpy.core.multiarray\n_reconstruct\n.".to_vec(), "Format", "_reconstruct"),
    ] {
        let made = Made::new();
        made.set_camera(column, &bytes);
        refused(&made, want, text);
    }
}

/// Gives a table the same rows in another order, or other types.
fn rebuild(table: &str, select: &str) -> String {
    format!("CREATE TABLE other AS {select}; DROP TABLE {table}; ALTER TABLE other RENAME TO {table};")
}

#[test]
fn other_orders_types_and_absent_optional_tables_load() {
    let made = Made::new();
    let want = frames(&open(&made.config()));
    for table in ["image", "ego_pose", "lidar_pc", "lidar_box", "camera"] {
        made.change(&rebuild(table, &format!("SELECT * FROM {table} ORDER BY rowid DESC")));
    }
    made.change(&rebuild("camera", "SELECT token, channel, translation, rotation, intrinsic, distortion, width * 1.0 AS width, height * 1.0 AS height FROM camera"));
    made.change(&rebuild("image", "SELECT token, camera_token, filename_jpg, timestamp * 1.0 AS timestamp FROM image"));
    let got = frames(&open(&made.config()));
    assert_eq!(format!("{got:?}"), format!("{want:?}"));
    made.change("DROP TABLE log; DROP TABLE scene; DROP TABLE scenario_tag; DROP TABLE lidar_box; DROP TABLE lidar");
    let dataset = open(&made.config());
    assert!(!dataset.capabilities().boxes && !dataset.capabilities().text && dataset.logs()[0].location.is_none());
    let got = frames(&dataset);
    assert!(got.iter().zip(&want).all(|(got, want)| got.boxes.is_none() && got.timestamp_ns == want.timestamp_ns));
    made.change("DROP TABLE lidar_pc; DROP TABLE track; DROP TABLE category");
    for (got, want) in frames(&open(&made.config())).iter().zip(&want) {
        // Without lidar turns the middle of the exposures names the frame; here all cameras exposed with the lidar.
        assert_eq!((got.timestamp_ns, got.id.frame.clone()), (want.timestamp_ns, want.timestamp_ns.to_string()));
    }
}

#[test]
fn missing_velocities_are_none_and_missing_turns_are_not_annotated() {
    let made = Made::new();
    made.change("UPDATE lidar_box SET vy = NULL");
    let got = frames(&open(&made.config()));
    assert!(got.iter().all(|frame| frame.boxes.as_ref().unwrap().iter().all(|found| found.velocity.is_none())));
    made.change("DELETE FROM lidar_pc WHERE timestamp = (SELECT max(timestamp) FROM lidar_pc)");
    let got = frames(&open(&made.config()));
    assert!(got[0].boxes.is_some() && got[1].boxes.is_none());
    made.change("DELETE FROM lidar_box");
    assert_eq!(frames(&open(&made.config()))[0].boxes, Some(Vec::new()), "categories without boxes: nothing was there");
    made.change("DELETE FROM track; DELETE FROM category");
    assert_eq!(frames(&open(&made.config()))[0].boxes, None, "no categories: nobody looked");
}

#[test]
fn unknown_classes_can_be_given_a_rule_and_bad_frames_can_be_excluded() {
    let made = Made::new();
    made.change("UPDATE category SET name = 'HOVERBOARD' WHERE name = 'vehicle'");
    let mut config = made.config();
    config.classes.insert("HOVERBOARD".to_owned(), ClassRule::Drop);
    assert!(
        frames(&open(&config)).iter().all(|frame| frame
            .boxes
            .as_ref()
            .unwrap()
            .iter()
            .all(|b| b.source_class != "HOVERBOARD"))
    );
    let made = Made::new();
    let last = frames(&open(&made.config()))[1].id.frame.clone();
    made.change("DELETE FROM ego_pose WHERE timestamp > (SELECT min(timestamp) + 100000 FROM ego_pose)");
    let error = NuPlan::open(&made.config()).unwrap_err().to_string();
    assert!(error.contains(&last), "{error}");
    let config = NuPlanConfig { exclude: vec![last], ..made.config() };
    assert_eq!(open(&config).len(), 1);
}

#[test]
fn pictures_come_and_go() {
    let made = Made::new();
    let want = frames(&open(&made.config()));
    let pictures = |channel: &str| {
        let folder = made.blobs().join("scene-0000").join(channel);
        let mut names: Vec<_> = std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path()).collect();
        names.sort();
        names
    };
    let file =
        |frame: &SceneFrame, at: usize| crate::nuscenes::image_path(frame.views[at].image.as_ref()).unwrap().to_owned();
    let lost = file(&want[1], 2);
    std::fs::remove_file(&lost).unwrap();
    let dataset = open(&made.config());
    assert_eq!(dataset.logs()[0].absent_pictures, 1);
    let view = dataset.frame(1).unwrap().views[2].clone();
    assert!(view.image.is_none());
    assert_eq!(
        (view.timestamp_ns, view.world_from_ego),
        (want[1].views[2].timestamp_ns, want[1].views[2].world_from_ego)
    );
    let whole = NuPlanConfig { require_all_views: true, ..made.config() };
    assert_eq!(open(&whole).len(), 1);
    let bytes = std::fs::read(file(&want[0], 0)).unwrap();
    std::fs::write(file(&want[0], 0), &bytes[..bytes.len() / 2]).unwrap();
    std::fs::write(file(&want[0], 1), b"no picture").unwrap();
    let found = check(&made.config(), 0).unwrap();
    assert_eq!((found.report.damaged(), found.report.missing(), found.report.absent_views), (2, 0, 1));
    made.change("UPDATE camera SET width = 63");
    let error = open(&made.config()).frame(0).unwrap().views[3].image.as_ref().unwrap().decode().unwrap_err();
    assert!(matches!(error, DataError::ImageSize { got: (64, 36), want: (63, 36), .. }), "{error}");
    // A log whose pictures are not there gives no frames and is named; alone it is an empty dataset.
    std::fs::copy(made.database(), made.database().with_file_name("silent.db")).unwrap();
    assert_eq!(open(&made.config()).logs_without_pictures(), ["silent"]);
    pictures("CAM_F0").iter().for_each(|path| std::fs::remove_file(path).unwrap());
    assert_eq!(open(&made.config()).len(), 2);
    std::fs::remove_dir_all(made.blobs()).unwrap();
    assert!(matches!(NuPlan::open(&made.config()), Err(DataError::Empty { .. })));
}

#[test]
fn damaged_databases_never_panic_or_hang() {
    let made = Made::new();
    let sound = std::fs::read(made.database()).unwrap();
    let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(3);
    let (started, mut loaded) = (Instant::now(), 0);
    for _ in 0..150 {
        let mut bytes = sound.clone();
        for _ in 0..rng.random_range(1..12) {
            // Half the changes hit page headers and the schema, where they hurt most.
            let at = if rng.random_bool(0.5) {
                rng.random_range(0..bytes.len())
            } else {
                4096 * rng.random_range(0..bytes.len() / 4096) + rng.random_range(0..120)
            };
            bytes[at] = rng.random();
        }
        if rng.random_bool(0.1) {
            bytes.truncate(rng.random_range(0..bytes.len()));
        }
        std::fs::write(made.database(), &bytes).unwrap();
        match read_everything(&made.config()) {
            Ok(_) => loaded += 1,
            Err(error) => assert!(!error.to_string().is_empty()),
        }
    }
    assert!(loaded < 150, "not one change was noticed");
    assert!(started.elapsed() < Duration::from_secs(60), "{:?}", started.elapsed());
}

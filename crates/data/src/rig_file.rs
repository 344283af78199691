//! Camera rigs as JSON files.

use std::path::Path;

use geometry::{CameraRig, Rigid};

use crate::DataError;

/// Rounding of a quaternion's length.
const UNIT: f64 = 1e-12;

/// Reads a JSON file that holds a [`CameraRig`].
///
/// # Errors
/// [`DataError::Missing`], [`DataError::Io`], [`DataError::Json`]; [`DataError::Empty`] for a rig without cameras;
/// [`DataError::Calibration`] for unusable intrinsics, lens numbers or poses; [`DataError::Config`] for a name given twice.
pub fn read_rig(path: &Path) -> Result<CameraRig, DataError> {
    let text = std::fs::read_to_string(path).map_err(|source| match source.kind() {
        std::io::ErrorKind::NotFound => DataError::Missing { what: "camera rig".into(), path: path.into() },
        _ => DataError::Io { action: "read", source, path: path.into() },
    })?;
    let mut rig: CameraRig =
        serde_json::from_str(&text).map_err(|e| DataError::Json { why: e.to_string(), path: path.into() })?;
    if rig.is_empty() {
        return Err(DataError::Empty { what: "the camera rig".into(), path: path.into() });
    }
    let mut names: Vec<&str> = rig.cameras.iter().map(|camera| camera.channel.as_str()).collect();
    names.sort_unstable();
    if let Some(twice) = names.windows(2).find(|pair| pair[0] == pair[1]) {
        let why = format!("two cameras of the rig are called {:?}: {}", twice[0], path.display());
        return Err(DataError::Config(why));
    }
    for camera in &mut rig.cameras {
        let row = camera.channel.clone();
        let bad = |source| DataError::Calibration { row, source, path: path.into() };
        let pose = &camera.ego_from_cam;
        let sound = Rigid::from_wxyz(pose.wxyz(), pose.translation.to_array());
        let sound = sound.and_then(|pose| camera.camera().map(|_| pose)).map_err(bad)?;
        // A rotation that is one already comes back to the bit.
        if (camera.ego_from_cam.rotation.length() - 1.0).abs() > UNIT {
            camera.ego_from_cam = sound;
        }
    }
    Ok(rig)
}

#[cfg(test)]
mod tests {
    use geometry::RigPreset;

    use super::*;

    fn read(text: &str) -> Result<CameraRig, String> {
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), text).unwrap();
        read_rig(file.path()).map_err(|error| {
            let text = error.to_string();
            assert!(text.contains(&file.path().display().to_string()), "{text}");
            text
        })
    }

    #[test]
    fn every_built_in_rig_survives_its_file() {
        for preset in RigPreset::ALL {
            let rig = preset.rig();
            let again = read(&serde_json::to_string_pretty(&rig).unwrap()).unwrap();
            assert_eq!(again.len(), rig.len());
            for (a, b) in rig.cameras.iter().zip(&again.cameras) {
                assert_eq!((&a.channel, a.intrinsics, a.lens), (&b.channel, b.intrinsics, b.lens));
                assert!(a.ego_from_cam.rotation.angle_between(b.ego_from_cam.rotation) < 1e-7);
                assert_eq!(a.ego_from_cam.translation, b.ego_from_cam.translation);
            }
        }
    }

    #[test]
    fn unusable_rigs_are_refused_with_file_and_camera() {
        let sound = serde_json::to_value(RigPreset::NuScenes.rig()).unwrap();
        let broken = |change: &dyn Fn(&mut serde_json::Value)| {
            let mut value = sound.clone();
            change(&mut value);
            read(&value.to_string()).unwrap_err()
        };
        assert!(broken(&|v| v["cameras"] = serde_json::json!([])).contains("camera rig"));
        assert!(broken(&|v| v["cameras"][1]["channel"] = "CAM_FRONT".into()).contains("CAM_FRONT"));
        assert!(broken(&|v| v["cameras"][1]["intrinsics"]["fx"] = 0.0.into()).contains("CAM_FRONT_RIGHT"));
        let turned = broken(&|v| v["cameras"][2]["ego_from_cam"]["rotation"] = serde_json::json!([0, 0, 0, 2]));
        assert!(turned.contains("CAM_BACK_RIGHT"), "{turned}");
        assert!(broken(&|v| v["cameras"][0]["lens"] = "Mirror".into()).contains("Mirror"));
        assert!(broken(&|v| v["cameras"][0]["focal"] = 1.into()).contains("focal"));
        assert!(read("cameras").is_err());
    }
}

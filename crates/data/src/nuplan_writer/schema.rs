//! The tables of a log, with the column names and types of the release.

/// Name and columns of every table, in the order of writing.
pub(super) const TABLES: [(&str, &str); 12] = [
    ("category", "token BLOB NOT NULL, name VARCHAR(64), description TEXT"),
    (
        "log",
        "token BLOB NOT NULL, vehicle_name VARCHAR(64), date VARCHAR(64), timestamp INTEGER, logfile VARCHAR(64), \
         location VARCHAR(64), map_version VARCHAR(64)",
    ),
    (
        "camera",
        "token BLOB NOT NULL, log_token BLOB NOT NULL, channel VARCHAR(64), model VARCHAR(64), translation BLOB, \
         rotation BLOB, intrinsic BLOB, distortion BLOB, width INTEGER, height INTEGER",
    ),
    (
        "ego_pose",
        "token BLOB NOT NULL, timestamp INTEGER, x FLOAT, y FLOAT, z FLOAT, qw FLOAT, qx FLOAT, qy FLOAT, qz FLOAT, \
         vx FLOAT, vy FLOAT, vz FLOAT, acceleration_x FLOAT, acceleration_y FLOAT, acceleration_z FLOAT, \
         angular_rate_x FLOAT, angular_rate_y FLOAT, angular_rate_z FLOAT, epsg INTEGER, log_token BLOB NOT NULL",
    ),
    (
        "lidar",
        "token BLOB NOT NULL, log_token BLOB NOT NULL, channel VARCHAR(64), model VARCHAR(64), translation BLOB, \
         rotation BLOB",
    ),
    ("scene", "token BLOB NOT NULL, log_token BLOB NOT NULL, name TEXT, goal_ego_pose_token BLOB, roadblock_ids TEXT"),
    ("track", "token BLOB NOT NULL, category_token BLOB NOT NULL, width FLOAT, length FLOAT, height FLOAT"),
    (
        "image",
        "token BLOB NOT NULL, next_token BLOB, prev_token BLOB, ego_pose_token BLOB NOT NULL, \
         camera_token BLOB NOT NULL, filename_jpg VARCHAR(128), timestamp INTEGER",
    ),
    (
        "lidar_pc",
        "token BLOB NOT NULL, next_token BLOB, prev_token BLOB, ego_pose_token BLOB NOT NULL, \
         lidar_token BLOB NOT NULL, scene_token BLOB, filename VARCHAR(128), timestamp INTEGER",
    ),
    (
        "lidar_box",
        "token BLOB NOT NULL, lidar_pc_token BLOB NOT NULL, track_token BLOB NOT NULL, next_token BLOB, \
         prev_token BLOB, x FLOAT, y FLOAT, z FLOAT, width FLOAT, length FLOAT, height FLOAT, vx FLOAT, vy FLOAT, \
         vz FLOAT, yaw FLOAT, confidence FLOAT",
    ),
    ("scenario_tag", "token BLOB NOT NULL, lidar_pc_token BLOB NOT NULL, type TEXT, agent_track_token BLOB"),
    (
        "traffic_light_status",
        "token BLOB NOT NULL, lidar_pc_token BLOB NOT NULL, lane_connector_id INTEGER, status VARCHAR(8)",
    ),
];

/// Table and column of every index, for the queries that readers make for each frame.
pub(super) const INDICES: [(&str, &str); 5] = [
    ("image", "camera_token"),
    ("image", "timestamp"),
    ("lidar_box", "lidar_pc_token"),
    ("scenario_tag", "lidar_pc_token"),
    ("lidar_pc", "timestamp"),
];

/// The release's category names in its order.
pub(super) const CATEGORIES: [&str; 7] =
    ["vehicle", "bicycle", "pedestrian", "traffic_cone", "barrier", "czone_sign", "generic_object"];

/// The statements that make the empty tables.
pub(super) fn ddl() -> String {
    let tables =
        TABLES.iter().map(|(name, columns)| format!("CREATE TABLE {name} ({columns}, PRIMARY KEY (token));\n"));
    let indices =
        INDICES.iter().map(|(table, column)| format!("CREATE INDEX ix_{table}_{column} ON {table} ({column});\n"));
    tables.chain(indices).collect()
}

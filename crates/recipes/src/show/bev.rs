//! The frame from above: x up, y left, the car's origin in the middle.

use data::{LocalMap, MapKind, ObjectBox, OccupancyGrid, View};
use geometry::Rigid;
use geometry::glam::{DVec2, DVec3, Vec3Swizzles};

use super::canvas::{Canvas, Color};
use super::objects::FRONT;
use super::{Layer, PageContent, PageOptions, colors};

/// Distance between the circles around the car, metres.
const CIRCLES_M: [f64; 4] = [10.0, 20.0, 40.0, 80.0];
/// How far a camera's angle of view is drawn, as a share of the panel's half side.
const SIGHT_SHARE: f64 = 0.3;
/// A car around its rear axle, metres: only shows which way is forward.
const EGO_X_M: [f64; 2] = [-1.0, 3.9];
const EGO_HALF_WIDTH_M: f64 = 0.95;
/// Rows of the picture at which the sides of its view are taken.
const MIDDLE_ROW: f64 = 0.5;

struct Panel {
    canvas: Canvas,
    half_m: f64,
    scale: u32,
}

/// The first letters of a name that are drawn; tokens are no reading matter.
const NAME_LETTERS: usize = 18;

/// The drawn square of this side.
pub(super) fn draw(content: &PageContent, options: &PageOptions, side: u32, scale: u32) -> Canvas {
    let half_m = options.range_m;
    let show_occupancy = options.layers.contains(&Layer::Occupancy);
    let mut panel = Panel { canvas: Canvas::new(side, side, [34, 36, 40]), half_m, scale };
    if let Some(grid) = content.occupancy.as_ref().filter(|_| show_occupancy) {
        panel.occupancy(grid);
    }
    panel.areas(&content.map, if content.occupancy.is_some() && show_occupancy { 0.12 } else { 0.3 });
    panel.circles();
    panel.lines(&content.map);
    for (index, view) in content.frame.views.iter().enumerate() {
        panel.sight(index, view, &content.frame.world_from_ego);
    }
    panel.ego();
    content.frame.boxes.iter().flatten().for_each(|object| panel.object(object));
    if options.layers.contains(&Layer::Names) {
        content.frame.boxes.iter().flatten().for_each(|object| panel.name(object));
    }
    panel.canvas.label(DVec2::ZERO, scale, colors::INK, &format!("from above, {half_m:.0} m each way"));
    panel.canvas
}

impl Panel {
    fn px_per_m(&self) -> f64 {
        self.canvas.size().x / (2.0 * self.half_m)
    }

    fn pixel(&self, ego: DVec2) -> DVec2 {
        0.5 * self.canvas.size() + self.px_per_m() * DVec2::new(-ego.y, -ego.x)
    }

    fn metres(&self, pixel: DVec2) -> DVec2 {
        let off = (pixel - 0.5 * self.canvas.size()) / self.px_per_m();
        DVec2::new(-off.y, -off.x)
    }

    fn polyline(&mut self, points: impl IntoIterator<Item = DVec2>, color: Color, width: f64) {
        let points: Vec<DVec2> = points.into_iter().map(|point| self.pixel(point)).collect();
        self.canvas.polyline(&points, color, width * f64::from(self.scale));
    }

    /// The highest label of each column, brighter the higher it lies.
    fn occupancy(&mut self, grid: &OccupancyGrid) {
        let (width, height) = self.canvas.picture.dimensions();
        let grid_from_ego = grid.ego_from_grid.inverse();
        let [layers, _, _] = grid.grid.cells;
        for (x, y) in (0..height).flat_map(|y| (0..width).map(move |x| (x, y))) {
            let ego = self.metres(DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5));
            let below = (grid_from_ego * ego.extend(0.0)).xy();
            let Some([_, row, column]) = grid.grid.cell_of(below.extend(grid.grid.center(0, 0, 0).z)) else { continue };
            let filled = |label: &u8| *label != grid.free() && *label != OccupancyGrid::IGNORED;
            let top = (0..layers).rev().find_map(|z| Some((z, grid.label([z, row, column]).filter(filled)?)));
            if let Some((z, label)) = top {
                let bright = 0.65 + 0.35 * (z + 1) as f64 / layers as f64;
                let color = colors::of_label(grid.label_set, label).map(|value| (f64::from(value) * bright) as u8);
                self.canvas.blend(i64::from(x), i64::from(y), color, 0.85);
            }
        }
    }

    fn areas(&mut self, map: &LocalMap, amount: f64) {
        // The drivable area lies below what is painted on it.
        let (ground, painted): (Vec<_>, Vec<_>) = map.areas.iter().partition(|area| area.kind == MapKind::Boundary);
        for area in ground.into_iter().chain(painted) {
            let color = if area.kind == MapKind::Boundary { colors::FAINT } else { colors::of_map(area.kind) };
            let ring = |ring: &Vec<[f64; 2]>| ring.iter().map(|p| self.pixel(DVec2::from_array(*p))).collect();
            let rings: Vec<Vec<DVec2>> = [&area.outer].into_iter().chain(&area.holes).map(ring).collect();
            self.canvas.fill(&rings, color, amount);
        }
    }

    fn circles(&mut self) {
        let half_m = self.half_m;
        for radius in CIRCLES_M.into_iter().filter(|radius| *radius < half_m) {
            let point = |i: u32| radius * DVec2::from_angle(f64::from(i) * 2f64.to_radians());
            self.polyline((0..=180).map(point), colors::FAINT, 0.4);
            let at = self.pixel(DVec2::new(radius, 0.0));
            self.canvas.text(at, self.scale, colors::FAINT, &format!("{radius:.0}"));
        }
    }

    fn lines(&mut self, map: &LocalMap) {
        for line in &map.lines {
            let width = if line.kind == MapKind::Centerline { 0.4 } else { 0.9 };
            self.polyline(line.points.iter().map(|p| DVec3::from_array(*p).xy()), colors::of_map(line.kind), width);
        }
    }

    /// Where a camera stands and between which directions it sees, from its own pose.
    fn sight(&mut self, index: usize, view: &View, world_from_ego: &Rigid) {
        let Ok(camera) = view.camera() else { return };
        let ego_from_cam = view.ref_ego_from_cam(world_from_ego);
        let (width, height) = (f64::from(view.intrinsics.width), f64::from(view.intrinsics.height));
        let radius = SIGHT_SHARE * self.half_m;
        let towards = |share: f64| {
            let ray = camera.unproject(DVec2::new(share * width, MIDDLE_ROW * height))?;
            Some(ego_from_cam.transform_vector(ray).xy().normalize_or_zero())
        };
        let center = ego_from_cam.translation.xy();
        let color = if view.image.is_some() { colors::INK } else { colors::IGNORED };
        let arc = (0..=16).filter_map(|i| towards(f64::from(i) / 16.0)).map(|way| center + radius * way);
        let outline: Vec<DVec2> = [center].into_iter().chain(arc).chain([center]).collect();
        let filled: Vec<DVec2> = outline.iter().map(|point| self.pixel(*point)).collect();
        self.canvas.fill(&[filled], color, 0.05);
        self.polyline(outline, color, 0.4);
        if let Some(way) = towards(0.5) {
            let at = self.pixel(center + 0.85 * radius * way) - 4.0 * f64::from(self.scale);
            self.canvas.text(at, self.scale, color, &(index + 1).to_string());
        }
    }

    fn ego(&mut self) {
        let [rear, front] = EGO_X_M;
        let half = EGO_HALF_WIDTH_M;
        let nose = 0.7 * front;
        let outline = [(rear, half), (nose, half), (front, 0.0), (nose, -half), (rear, -half), (rear, half)];
        let points: Vec<DVec2> = outline.map(|(x, y)| self.pixel(DVec2::new(x, y))).to_vec();
        self.canvas.fill(std::slice::from_ref(&points), colors::EGO, 0.5);
        self.canvas.polyline(&points, colors::EGO, f64::from(self.scale));
    }

    fn name(&mut self, object: &ObjectBox) {
        let name: String = object.track.chars().take(NAME_LETTERS).collect();
        let at = self.pixel(object.box3d.center.xy()) + f64::from(2 * self.scale);
        // The smallest letters: boxes lie close together.
        self.canvas.text(at, 1, colors::of_class(object.class), &name);
    }

    /// Outline from above, front edge thick, a line for the way of one second.
    fn object(&mut self, object: &ObjectBox) {
        let color = colors::of_class(object.class);
        let corners = object.box3d.corners().map(|corner| corner.xy());
        // Upper corners: front left, front right, rear right, rear left.
        let outline = [0, 1, 5, 4].map(|i| corners[i]);
        let pixels: Vec<DVec2> = outline.iter().map(|corner| self.pixel(*corner)).collect();
        self.canvas.fill(&[pixels], color, 0.35);
        self.polyline(outline.into_iter().chain([outline[0]]), color, 0.6);
        self.polyline(FRONT[..2].iter().map(|i| corners[*i]), color, 1.8);
        let center = object.box3d.center.xy();
        if let Some(velocity) = object.velocity.map(DVec2::from_array).filter(|way| way.length() > 0.5) {
            self.polyline([center, center + velocity], color, 0.8);
        }
    }
}

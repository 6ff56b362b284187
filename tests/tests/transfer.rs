//! Held-out poses carried into the frame of refined telemetry: measured by leaving out each training view in turn, whose own
//! refined pose is then the truth. Needs the reference data (`DGTR_DATA`); says so and passes without.
#![allow(clippy::expect_used, clippy::panic, reason = "a test fails by panicking")]

use engine::transfer::PoseTransfer;
use models::camera::View;
use models::refine::Refiner;
use survey::dataset::{Dataset, PoseSource};

use needs::shared;

/// Mean distance of a few ground points' projections, pixels.
fn apart_px(a: &View, b: &View, depth: f64) -> f64 {
    let k = &a.intrinsics;
    let mut sum = 0.0;
    let corners = [(0.5, 0.5), (0.1, 0.1), (0.9, 0.1), (0.1, 0.9), (0.9, 0.9)];
    for (u, v) in corners {
        let x = (u * f64::from(k.width) - f64::from(k.cx)) / f64::from(k.fx) * depth;
        let y = (v * f64::from(k.height) - f64::from(k.cy)) / f64::from(k.fy) * depth;
        let forward = a.pose.forward();
        let (right, down) = (a.pose.rotation.mul_vec3(X.into()), a.pose.rotation.mul_vec3(Y.into()));
        let p = a.pose.center + right * x + down * y + forward * depth;
        let c = b.pose.rotation.conjugate() * (p - b.pose.center);
        let (px, py) = (c.x / c.z * f64::from(k.fx), c.y / c.z * f64::from(k.fy));
        sum += (px - x / depth * f64::from(k.fx)).hypot(py - y / depth * f64::from(k.fy));
    }
    sum / corners.len() as f64
}

const X: [f64; 3] = [1.0, 0.0, 0.0];
const Y: [f64; 3] = [0.0, 1.0, 0.0];

#[test]
fn a_held_out_pose_lands_within_a_pixel_of_where_refinement_would_have_put_it() {
    let Some(folder) = shared("data/sheffield_cross") else { return };
    if models::onnx::session::find_library().is_err() {
        needs::missing(needs::Need::OnnxRuntime, "ONNX Runtime is not there");
        return;
    }
    let set = Dataset::open(&folder).expect("data set");
    let frames = set.select("train", None).expect("split");
    let mut refiner = Refiner::open(&Default::default()).expect("refiner");
    let mut views = Vec::new();
    for &i in &frames {
        let picture = set.load_posed(i, 1.0, PoseSource::Telemetry).expect("picture");
        refiner.add(&picture).expect("added");
        views.push((picture.name.clone(), picture.view));
    }
    refiner.solve().expect("solved");
    for (name, view) in &mut views {
        view.pose = refiner.pose(name).expect("pose");
    }
    let mut errors = Vec::new();
    for (at, &i) in frames.iter().enumerate() {
        let others: Vec<(String, View)> =
            views.iter().enumerate().filter(|(j, _)| *j != at).map(|(_, v)| v.clone()).collect();
        let carried = PoseTransfer::between(&set, &others).apply(&set.frames[i].view.pose);
        let own = views[at].1;
        let carried = View { pose: carried, ..own };
        errors.push(apart_px(&own, &carried, 64.0));
        if std::env::var_os("DGTR_VERBOSE").is_some() {
            let turn = own.pose.rotation.angle_between(carried.pose.rotation).to_degrees();
            let shift = own.pose.center.distance(carried.pose.center);
            println!("{}: {:.2} px, {shift:.3} m, {turn:.3}°", views[at].0, errors[at]);
        }
    }
    errors.sort_by(f64::total_cmp);
    let (median, worst) = (errors[errors.len() / 2], errors[errors.len() - 1]);
    println!("carried poses: median {median:.2} px, 90 % {:.2} px, worst {worst:.2} px", errors[errors.len() * 9 / 10]);
    assert!(median < 1.0, "{median} px");
}

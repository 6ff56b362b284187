//! What is chosen, with made-up devices.

use vulkan::gpu::GpuInfo;

use super::*;
use tuning::fixtures::device;
use tuning::fixtures::{CARD, PROCESSOR};

fn room(device_mib: u32) -> Room {
    Room { device_mib, is_said: false, host_bytes: None, is_host: false }
}

/// A survey of so many pictures.
fn survey(views: usize, picture: (u32, u32), seconds: Option<f64>) -> Wanted {
    let device = DeviceRequest {
        device: None,
        memory: Memory { device_mib: Some(0), ..Memory::default() },
        size: picture,
        views,
        crops: 1,
        folder: None,
    };
    Wanted {
        picture,
        most_side: most_side(picture, seconds),
        views,
        share: shown(views),
        device,
        sh: ShSettings::default(),
        resolution: ResolutionSettings::default(),
        schedule: 100 * views as u32,
        steps: None,
        seconds,
        max_gaussians: None,
        image_scale: None,
    }
}

fn chosen(wanted: &Wanted, cost: &CostModel, mib: u32) -> Choice {
    let choice = wanted.choose(cost, &room(mib), Lanes::BOARD).expect("a choice");
    // Whatever is chosen has a plan, and one that holds it.
    let scaled = wanted.request(choice.image_scale, choice.max_gaussians, choice.device_mib);
    let plan = Plan::new(&scaled.plan_request(&wanted.sh, Lanes::BOARD)).expect("a plan");
    assert!(plan.gaussians as u32 >= choice.max_gaussians.min(plan.gaussians as u32), "{choice}");
    assert!(choice.is_sound() && choice.device_mib <= mib, "{choice}");
    choice
}

fn side(choice: &Choice) -> u32 {
    (f64::from(choice.picture.0.max(choice.picture.1)) * choice.image_scale).round() as u32
}

#[test]
fn more_time_and_a_faster_device_choose_larger_points_and_never_smaller_ones() {
    let slow = CostModel { evaluation_ns: 60.0, visible_ns: 6000.0, pixel_ns: 1600.0, ..PROCESSOR };
    for cost in [slow, PROCESSOR, CARD] {
        let mut last = 0;
        for seconds in [1.0, 10.0, 40.0, 160.0, 600.0, 1e4] {
            let choice = chosen(&survey(43, (640, 480), Some(seconds)), &cost, 2048);
            let size = side(&choice) * 10 + choice.max_gaussians / 100_000;
            assert!(size >= last, "{seconds} s: {choice}");
            last = size;
        }
    }
    let by = |cost| side(&chosen(&survey(43, (640, 480), Some(10.0)), cost, 2048));
    assert!(by(&slow) < by(&PROCESSOR) && by(&PROCESSOR) < by(&CARD), "{} {} {}", by(&slow), by(&PROCESSOR), by(&CARD));
}

#[test]
fn a_slow_board_gets_enough_visits_by_smaller_pictures() {
    let board = CostModel { evaluation_ns: 60.0, visible_ns: 6000.0, pixel_ns: 1600.0, ..PROCESSOR };
    let choice = chosen(&survey(43, (1280, 960), Some(60.0)), &board, 512);
    assert!(choice.limited_by == Limit::Time && choice.steps >= 43 * VISITS, "{choice}");
    assert!(side(&choice) < 640, "{choice}");
}

#[test]
fn a_fast_card_with_time_trains_a_folders_pictures_as_large_as_they_come() {
    let choice = chosen(&survey(43, (1280, 960), Some(120.0)), &CARD, 4096);
    assert_eq!((choice.limited_by, choice.image_scale), (Limit::Pictures, 1.0), "{choice}");
    assert!(choice.max_gaussians > 100_000, "{choice}");
    // Without anybody's word on time: the size that was measured.
    let unsaid = chosen(&survey(43, (1280, 960), None), &CARD, 4096);
    assert_eq!((side(&unsaid), unsaid.steps, unsaid.seconds), (640, 4300, None), "{unsaid}");
}

#[test]
fn one_second_is_the_smallest_point_and_a_choice_all_the_same() {
    let choice = chosen(&survey(43, (640, 480), Some(1.0)), &PROCESSOR, 512);
    assert_eq!((choice.limited_by, side(&choice)), (Limit::Time, 160), "{choice}");
    assert!(choice.max_gaussians >= 1000 && choice.steps >= 1);
}

#[test]
fn little_memory_limits_the_gaussians_and_then_the_pictures() {
    let wanted = survey(43, (640, 480), Some(3600.0));
    let (little, much) = (chosen(&wanted, &CARD, 96), chosen(&wanted, &CARD, 2048));
    assert_eq!((little.limited_by, much.limited_by), (Limit::Memory, Limit::Pictures), "{little}\n{much}");
    assert!(little.max_gaussians < much.max_gaussians, "{little}\n{much}");
    // Not even one picture finds room: no choice, and the plan says what is missing.
    assert_eq!(
        Wanted { image_scale: Some(1.0), ..survey(43, (1280, 960), None) }.choose(&CARD, &room(16), Lanes::BOARD),
        None
    );
}

#[test]
fn a_thousand_pictures_get_as_many_gaussians_as_the_memory_holds() {
    let choice = chosen(&survey(1000, (4000, 3000), None), &CARD, 512);
    assert!(choice.limited_by == Limit::Memory && choice.max_gaussians > 150_000, "{choice}");
    assert!(choice.device_mib > 400, "{choice}");
}

#[test]
fn huge_pictures_are_made_smaller_until_a_plan_can_be_made() {
    for picture in [(30_000, 20_000), (20_000, 30_000), (40_000, 16)] {
        let choice = chosen(&survey(12, picture, Some(1e4)), &CARD, 1024);
        assert!(choice.image_scale < 1.0, "{choice}");
    }
}

#[test]
fn what_was_said_stays_and_the_rest_is_chosen_beside_it() {
    let said = Wanted { max_gaussians: Some(10_756), image_scale: Some(1.0), ..survey(43, (270, 480), None) };
    let choice = chosen(&said, &PROCESSOR, 2048);
    assert_eq!((choice.max_gaussians, choice.image_scale), (10_756, 1.0));
    let said = Room { device_mib: 700, is_said: true, ..room(0) };
    let choice = survey(43, (640, 480), Some(40.0)).choose(&PROCESSOR, &said, Lanes::BOARD).unwrap();
    assert_eq!(choice.device_mib, 700);
    let steps = Wanted { steps: Some(50), ..survey(43, (640, 480), None) };
    let choice = chosen(&steps, &PROCESSOR, 2048);
    assert_eq!((choice.steps, choice.seconds), (50, None), "{choice}");
}

#[test]
fn a_schedule_that_begins_with_small_pictures_is_forecast_to_have_more_steps_in_the_same_time() {
    let whole = ResolutionSettings { quarter_until: 0.0, half_until: 0.0, ..Default::default() };
    let of = |resolution, steps, seconds| {
        let wanted = Wanted { resolution, steps, image_scale: Some(1.0), ..survey(43, (640, 480), seconds) };
        chosen(&wanted, &PROCESSOR, 2048)
    };
    let half = ResolutionSettings { half_until: 0.5, ..whole };
    let (long, short) = (of(whole, None, Some(40.0)), of(half, None, Some(40.0)));
    assert!(f64::from(short.steps) > 1.2 * f64::from(long.steps), "{short}\n{long}");
    // Half of the steps at half the size, not half of the time.
    let by_steps = of(half, Some(100), None);
    assert!(by_steps.step_ms > short.step_ms && by_steps.step_ms < long.step_ms, "{by_steps}");
}

#[test]
fn a_schedule_that_nobody_would_wait_for_gets_seconds() {
    let slow = CostModel { fixed_ms: 1000.0, ..PROCESSOR };
    let choice = chosen(&survey(100, (640, 480), None), &slow, 512);
    assert_eq!((choice.seconds, choice.limited_by), (Some(SECONDS), Limit::Time), "{choice}");
}

#[test]
fn the_choice_is_said_in_one_line_with_its_reason() {
    let line = chosen(&survey(43, (640, 480), Some(40.0)), &CARD, 2048).to_string();
    assert!(line.starts_with("auto: ") && line.lines().count() == 1, "{line}");
    for word in ["Gaussians at", "of 640×480", "ms a step forecast", "steps in", "visits a picture", "limited by"] {
        assert!(line.contains(word), "{line}");
    }
}

#[test]
fn a_choice_is_kept_and_a_damaged_one_is_none() {
    let dir = tempfile::tempdir().unwrap();
    assert_eq!(Choice::kept(dir.path()), None);
    let choice = chosen(&survey(43, (640, 480), Some(40.0)), &PROCESSOR, 2048);
    choice.keep(dir.path()).unwrap();
    assert_eq!(Choice::kept(dir.path()), Some(choice));
    let bad = [b"{".to_vec(), b"{\"max_gaussians\": 7}".to_vec(), vec![b' '; 1 << 20], b"\xff".to_vec()];
    let scaled = serde_json::to_string(&Choice { image_scale: 7.0, ..choice }).unwrap().into_bytes();
    for bytes in bad.into_iter().chain([scaled]) {
        std::fs::write(dir.path().join(FILE), bytes).unwrap();
        assert_eq!(Choice::kept(dir.path()), None);
    }
}

#[test]
fn forecast_and_truth_stand_side_by_side_in_the_figures() {
    let choice = chosen(&survey(43, (640, 480), Some(10.0)), &PROCESSOR, 2048);
    let mut report = RunReport::new("train");
    choice.note(&mut report);
    assert!(report.more["forecast"].get("measured_ms").is_none(), "nothing was trained");
    (report.steps, *report.stage_ms.entry("train".into()).or_default()) = (10, 500.0);
    choice.note(&mut report);
    assert_eq!(report.more["forecast"]["measured_ms"], 50.0);
    assert_eq!(report.more["forecast"]["step_ms"], choice.step_ms);
    assert_eq!(report.more["forecast"]["limited_by"], "time");
}

#[test]
fn memory_is_a_part_of_what_there_is_and_less_in_flight() {
    let mib = |info: &GpuInfo, host| Room::of(info, None, host).device_mib;
    let board = device("V3D");
    let card = GpuInfo { is_integrated: false, heap_bytes: 80 << 30, ..board.clone() };
    let processor = GpuInfo { is_cpu: true, heap_bytes: 24 << 30, ..board.clone() };
    assert_eq!([&board, &card, &processor].map(|d| mib(d, None)), [256, 8192, 2048]);
    assert_eq!([&board, &card, &processor].map(|d| mib(d, Some(2048))), [256, 2048, 512]);
    assert_eq!(mib(&GpuInfo { heap_bytes: 0, ..board.clone() }, None), 64);
    assert!(Room::of(&board, Some(300), None).is_said);
    // A processor's plan and the cloud share the host's bound.
    let plan = Plan::new(
        &survey(43, (640, 480), None).request(1.0, 400_000, 512).plan_request(&ShSettings::default(), Lanes::BOARD),
    );
    let plan = plan.unwrap();
    let held = |host| Room::of(&processor, None, Some(host)).held(&plan, &ShSettings::default());
    assert!(held(600) < held(1800) && held(1800) < held(8192) && held(8192) == plan.gaussians as u32);
}

mod flights {
    use config::mission::Mission;

    use super::*;
    use crate::preset::flight::choose;
    use job::session;

    fn mission(more: &str) -> Mission {
        let text = format!(
            r#"name = "park"
{more}
[origin]
lat_deg = 47.0
lon_deg = 8.5
alt_m = 400.0
[camera]
width = 4056
height = 3040
fx = 3500.0
fy = 3500.0
cx = 2028.0
cy = 1520.0
[[aircraft]]
id = "a"
link = "udpin:127.0.0.1:1"
camera = {{ folder = "c" }}
region_enu = [[0.0, 0.0], [60.0, 0.0], [60.0, 40.0], [0.0, 40.0]]
"#
        );
        Mission::parse(&text, Path::new("/m")).unwrap()
    }

    #[test]
    fn a_flight_is_chosen_for_its_survey_at_the_working_size_at_the_most() {
        let m = mission("");
        let choice = choose(&m, &m.region(&m.aircraft[0]), &device("V3D"), &CARD).unwrap();
        assert_eq!((choice.views, side(&choice)), (96, 640), "{choice}");
        assert!(choice.device_mib <= 512, "{choice}");
        // Nobody says how large the ground is: as many as there may be.
        assert_eq!(choose(&m, &[], &device("V3D"), &CARD).unwrap().views, 256);
    }

    #[test]
    fn a_flight_that_goes_on_keeps_its_plan_and_one_that_began_without_a_choice_keeps_none() {
        let dir = tempfile::tempdir().unwrap();
        let mut m = mission("");
        let aircraft = m.aircraft[0].clone();
        let choice = choose(&m, &m.region(&aircraft), &device("V3D"), &PROCESSOR).unwrap();
        choice.keep(dir.path()).unwrap();
        assert_eq!(of_flight(&mut m, &aircraft, dir.path()), Some(choice));
        assert_eq!(m.memory.device_mib, Some(choice.device_mib));
        assert_eq!(m.memory.max_gaussians, Some(choice.max_gaussians));
        assert_eq!(m.memory.image_scale, Some(choice.image_scale as f32));
        // A number in the mission file wins, a mission with numbers and no preset is left alone.
        let mut said = mission("memory = { preset = \"auto\", max_gaussians = 777 }\ntraining = { seconds = 5.0 }");
        of_flight(&mut said, &aircraft, dir.path());
        assert_eq!((said.memory.max_gaussians, said.training.seconds), (Some(777), Some(5.0)));
        let mut numbers = mission("memory = { max_gaussians = 777 }");
        assert_eq!(of_flight(&mut numbers, &aircraft, dir.path()), None);
        assert_eq!(numbers, mission("memory = { max_gaussians = 777 }"));
        // Another mission's folder says nothing.
        let owner = session::Owner {
            command: "fly".into(),
            mission: "quarry".into(),
            aircraft: "a".into(),
            origin: [0.0; 3],
            picture: [64, 48],
        };
        drop(session::Session::begin(&disk::Disk::default(), dir.path(), &owner).unwrap());
        assert_ne!(of_flight(&mut mission(""), &aircraft, dir.path()), Some(choice));
        // One that began before there was a choice.
        let older = tempfile::tempdir().unwrap();
        std::fs::write(older.path().join("model.dgtr"), b"").unwrap();
        let mut m = mission("");
        assert_eq!(of_flight(&mut m, &aircraft, older.path()), None);
        assert_eq!(m, mission(""));
    }
}

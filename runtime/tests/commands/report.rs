//! What a user with a board sends in.

use super::dgtr;

#[test]
fn a_device_s_report_says_who_it_is_and_that_it_computes_what_the_reference_does() {
    if vulkan::gpu::Gpu::list().is_err() {
        needs::missing(needs::Need::Vulkan, "no Vulkan device (install mesa-vulkan-drivers)");
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    let file = dir.path().join("device.json");
    let path = file.to_string_lossy().into_owned();
    let small = ["--autotune-seconds", "0", "--sizes", "1", "--steps", "10"];
    let output = dgtr(&[&["doctor", "--report", &path][..], &small].concat());
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let text = String::from_utf8_lossy(&output.stdout);
    let report: serde_json::Value = serde_json::from_slice(&std::fs::read(&file).unwrap()).unwrap();
    let name = report["device"]["name"].as_str().unwrap();
    assert!(!name.is_empty() && text.contains(name), "{text}");
    let [device, reference] = ["loss", "reference_loss"].map(|loss| report["reference"][loss].as_f64().unwrap());
    assert!((device - reference).abs() < 2e-4, "{device} against {reference}");
    assert_eq!(report["sizes"].as_array().unwrap().len(), 1);
    assert_eq!(report["survey"]["steps"], 10);
    assert!(report["survey"]["psnr"].as_f64().unwrap() > 10.0);
    assert!(report["board"].as_array().unwrap().len() >= 4);
    // Nothing that tells whose computer it is.
    let host = std::fs::read_to_string("/proc/sys/kernel/hostname").unwrap_or_default();
    assert!(host.trim().len() < 4 || !report.to_string().contains(host.trim()));
}

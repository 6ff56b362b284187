//! The methods, each as what it changes of the trainer's and the ground's defaults, and what it leaves out of its source.
//!
//! What all share is in [`super::Request`]: pictures, poses, steps or seconds, Gaussians, memory, seed. Those that begin with few points
//! grow by half at a densification, so that they fill their room as ours does even in some hundred steps: region 0 of sheffield_cross
//! has 60,000 Gaussians after 400 steps and 21.95 dB / 0.606 on its held-out pictures, at the default of a fifth 16,000 and 21.99 / 0.603.

/// Which pictures a model is trained on.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Pictures {
    /// One model on the ground has all of them.
    All,
    /// Each region has those its aircraft took.
    Own,
    /// Each region has, besides, those of others that see it ([`super::visibility`]).
    Seen,
}

/// How the models of the regions become one.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Merge {
    /// There is one already.
    None,
    /// As `dgtr aggregate` does, with these lines of `[ground]`.
    ByRegion(&'static str),
    /// All Gaussians of all models, of which only the opacity is distilled ([`super::federated`]).
    Opacities,
}

/// One row of the comparison.
#[derive(Clone, Copy, Debug)]
pub struct Method {
    /// Name on the command line.
    pub name: &'static str,
    /// Value of `dgtr train --init`.
    pub start: &'static str,
    /// Pictures of each model.
    pub pictures: Pictures,
    /// TOML for `dgtr train --settings`: what differs from the defaults, and nothing else.
    pub settings: &'static str,
    /// What the ground does.
    pub merge: Merge,
    /// One of the paper's ablations of `dgtr`, which runs only when it is asked for.
    pub ablation: bool,
    /// What it is, and from whom.
    pub what: &'static str,
    /// Where it departs from its source.
    pub departs: &'static str,
}

/// 3DGS' growth under a hard cap, with `more` lines before and after.
macro_rules! growing {
    ($before:literal, $after:literal) => {
        concat!($before, "[training.density]\nstrategy = \"relocate\"\ngrowth = 0.5\n", $after)
    };
}

const NO_DEPTH: &str = growing!("[training.loss]\ndepth = 0.0\nview_dependence = 0.0\n", "");
/// Each region has its own aircraft's Gaussians, up to its border.
const PLAIN_UNION: &str = "border_m = 0.0\nepochs = 0\n";
const GROWTH: &str = "growth by relocation and splitting under the cap (3DGS-MCMC), not by gradients";

const DGTR: Method = Method {
    name: "dgtr",
    start: "feed-forward",
    pictures: Pictures::Own,
    settings: "",
    merge: Merge::ByRegion(""),
    ablation: false,
    what: "DGTR: feed-forward start, L1 + SSIM + Pearson depth with frozen shapes, merged by region and distilled",
    departs: "semi-global matching instead of Splatt3R and DPT; nothing is densified where the start fills its room; distilled at seams only",
};

/// All of them, in the order of the table.
pub const METHODS: &[Method] = &[
    DGTR,
    Method {
        name: "central-3dgs",
        start: "sfm",
        pictures: Pictures::All,
        settings: NO_DEPTH,
        merge: Merge::None,
        ablation: false,
        what: "3DGS (Kerbl et al. 2023) on all pictures: SfM points, densification, L1 + SSIM",
        departs: GROWTH,
    },
    Method {
        name: "distributed-3dgs",
        start: "sfm",
        pictures: Pictures::Own,
        settings: NO_DEPTH,
        merge: Merge::ByRegion(PLAIN_UNION),
        ablation: false,
        what: "D-3DGS of the paper's table: 3DGS per region, SfM points, plain union by region",
        departs: "growth as central-3dgs; each region begins with those points of one SfM that its own pictures saw",
    },
    Method {
        name: "vastgaussian",
        start: "sfm",
        pictures: Pictures::Seen,
        settings: growing!(
            "[training]\nrefine_exposure = true\n[training.loss]\ndepth = 0.0\nview_dependence = 0.0\n",
            ""
        ),
        merge: Merge::ByRegion(PLAIN_UNION),
        ablation: false,
        what: "VastGaussian (Lin et al. 2024): regions with the pictures of others that see them (airspace-aware, 25 %), appearance, union",
        departs: "gain and offset per picture and channel instead of its appearance network; no expansion of regions by 20 %; growth as central-3dgs",
    },
    Method {
        name: "fed-3dgs",
        start: "sfm",
        pictures: Pictures::Own,
        settings: NO_DEPTH,
        merge: Merge::Opacities,
        ablation: false,
        what: "Fed3DGS (Suzuki 2024): all of every client's model, opacities alone distilled with their entropy (rate 0.05, 5 epochs, a quarter of the size)",
        departs: "all clients at once, not one after another; no appearance vectors; growth as central-3dgs",
    },
    Method {
        name: "dngaussian",
        start: "random",
        pictures: Pictures::All,
        settings: growing!("[init]\ndepth_priors = true\n[training.loss]\nview_dependence = 0.0\n", ""),
        merge: Merge::None,
        ablation: false,
        what: "DNGaussian (Li et al. 2024) on all pictures, as in the paper's table: random start, depth-regularised with frozen shapes",
        departs: "one Pearson term moves places and opacities together, where it has a hard and a soft one on normalised patches; depths by semi-global matching",
    },
    Method {
        name: "dgtr-sfm",
        start: "sfm",
        settings: growing!("[init]\ndepth_priors = true\n", ""),
        ablation: true,
        what: "dgtr from SfM points, with densification",
        departs: "",
        ..DGTR
    },
    Method {
        name: "dgtr-no-depth",
        settings: "[training.loss]\ndepth = 0.0\n",
        ablation: true,
        what: "dgtr without the depth loss (the paper's table 2)",
        departs: "",
        ..DGTR
    },
    Method {
        name: "dgtr-free-shapes",
        settings: "[training.loss]\nfreeze_shape = false\n",
        ablation: true,
        what: "dgtr whose depth loss reaches scales and rotations (the paper's table 2)",
        departs: "",
        ..DGTR
    },
    Method {
        name: "dgtr-global-scale",
        settings: "[init]\nlocal_scale = false\n",
        ablation: true,
        what: "dgtr with the global scale of covariances alone (the paper's table 3)",
        departs: "",
        ..DGTR
    },
    Method {
        name: "dgtr-no-scales",
        settings: "[init]\nglobal_scale = false\nlocal_scale = false\n",
        ablation: true,
        what: "dgtr with neither scale (the paper's table 3)",
        departs: "",
        ..DGTR
    },
    Method {
        name: "dgtr-union",
        merge: Merge::ByRegion("epochs = 0\n"),
        ablation: true,
        what: "dgtr without distillation",
        departs: "",
        ..DGTR
    },
];

impl Method {
    /// The method of this name.
    pub fn named(name: &str) -> Option<&'static Self> {
        METHODS.iter().find(|m| m.name == name)
    }

    /// Whether any of its models begins with the points of a structure-from-motion.
    pub fn needs_points(&self) -> bool {
        self.start == "sfm"
    }
}

#[cfg(test)]
mod tests {
    use config::ground::GroundSettings;
    use config::init::InitSettings;
    use config::training::TrainSettings;
    use toml::{Table, Value};

    use super::*;

    #[derive(Default, serde::Serialize, serde::Deserialize)]
    #[serde(default, deny_unknown_fields)]
    struct Settings {
        training: TrainSettings,
        init: InitSettings,
    }

    /// Names and values of all settings that are no tables.
    fn flat(table: &Table, path: &str, into: &mut Vec<(String, String)>) {
        for (key, value) in table {
            let name = format!("{path}{key}");
            match value {
                Value::Table(below) => flat(below, &format!("{name}."), into),
                value => into.push((name, value.to_string())),
            }
        }
    }

    fn settings_of(table: &Table) -> Vec<(String, String)> {
        let mut all = Vec::new();
        flat(table, "", &mut all);
        all.sort();
        all
    }

    fn changed<T: serde::Serialize>(from: &T, to: &T) -> Vec<(String, String)> {
        let [from, to] = [from, to].map(|t| settings_of(&Table::try_from(t).expect("a table")));
        to.into_iter().filter(|setting| !from.contains(setting)).collect()
    }

    #[test]
    fn every_method_changes_exactly_the_settings_that_its_definition_states() {
        let growth = [("training.density.growth", "0.5"), ("training.density.strategy", "\"relocate\"")];
        let no_depth = ("training.loss.depth", "0.0");
        let theirs = [no_depth, ("training.loss.view_dependence", "0.0")];
        let wanted: &[(&str, Vec<(&str, &str)>)] = &[
            ("dgtr", vec![]),
            ("central-3dgs", [&growth[..], &theirs].concat()),
            ("distributed-3dgs", [&growth[..], &theirs].concat()),
            ("vastgaussian", [&growth[..], &theirs, &[("training.refine_exposure", "true")]].concat()),
            ("fed-3dgs", [&growth[..], &theirs].concat()),
            ("dngaussian", [&[("init.depth_priors", "true")], &growth[..], &theirs[1..]].concat()),
            ("dgtr-sfm", [&[("init.depth_priors", "true")], &growth[..]].concat()),
            ("dgtr-no-depth", vec![no_depth]),
            ("dgtr-free-shapes", vec![("training.loss.freeze_shape", "false")]),
            ("dgtr-global-scale", vec![("init.local_scale", "false")]),
            ("dgtr-no-scales", vec![("init.global_scale", "false"), ("init.local_scale", "false")]),
            ("dgtr-union", vec![]),
        ];
        assert_eq!(wanted.len(), METHODS.len());
        for (name, wanted) in wanted {
            let method = Method::named(name).expect(name);
            let settings: Settings = toml::from_str(method.settings).expect(name);
            assert!(settings.training.check().is_ok() && settings.init.check().is_ok(), "{name}");
            let wanted: Vec<_> = wanted.iter().map(|(k, v)| ((*k).to_owned(), (*v).to_owned())).collect();
            assert_eq!(changed(&Settings::default(), &settings), wanted, "{name}");
        }
    }

    #[test]
    fn others_are_united_up_to_the_border_without_distillation_and_ours_as_by_default() {
        for method in METHODS {
            match method.merge {
                Merge::ByRegion(text) => {
                    let ground: GroundSettings = toml::from_str(text).expect(method.name);
                    let wanted: &[(&str, &str)] = match method.name {
                        "distributed-3dgs" | "vastgaussian" => &[("border_m", "0.0"), ("epochs", "0")],
                        "dgtr-union" => &[("epochs", "0")],
                        _ => &[],
                    };
                    let wanted: Vec<_> = wanted.iter().map(|(k, v)| ((*k).to_owned(), (*v).to_owned())).collect();
                    assert_eq!(changed(&GroundSettings::default(), &ground), wanted, "{}", method.name);
                    assert_ne!(method.pictures, Pictures::All);
                }
                Merge::None => assert_eq!(method.pictures, Pictures::All, "{}", method.name),
                Merge::Opacities => assert_eq!(method.pictures, Pictures::Own, "{}", method.name),
            }
        }
    }

    #[test]
    fn names_are_unique_and_every_method_of_others_says_where_it_departs() {
        for (i, method) in METHODS.iter().enumerate() {
            assert!(METHODS[..i].iter().all(|m| m.name != method.name), "{}", method.name);
            assert!(!method.what.is_empty() && (method.ablation || !method.departs.is_empty()), "{}", method.name);
            assert!(!method.ablation || method.name.starts_with("dgtr-"), "{}", method.name);
        }
    }
}

//! The settings reference as a commented TOML file, made of the settings' own definitions.

use super::Mission;
use crate::settings::{Setting, Value};

/// Longest comment line.
const COLUMNS: usize = 110;

/// Every setting with what it does, its unit, its limits, its default and where that comes from. What has a default is
/// written with it; what has none is commented out.
pub fn reference() -> String {
    let mut out = String::new();
    comment(
        &mut out,
        "Every setting of a mission file with its default. Tables that are not given have these defaults.",
    );
    tables(&mut out, "", &Mission::settings(), false);
    out
}

/// First what lies directly in the table, then its tables: TOML wants them in this order. What lies in a table that may be absent is
/// commented out with it.
fn tables(out: &mut String, path: &str, settings: &[Setting], is_absent: bool) {
    let mark = if is_absent { "#" } else { "" };
    for s in settings.iter().filter(|s| s.settings.is_empty()) {
        comment(out, &explain(s));
        match &s.default {
            Some(default) => *out += &format!("{mark}{} = {default}\n", s.name),
            None => *out += &format!("#{} =\n", s.name),
        }
    }
    for s in settings.iter().filter(|s| !s.settings.is_empty()) {
        let path = if path.is_empty() { s.name.to_owned() } else { format!("{path}.{}", s.name) };
        *out += "\n";
        comment(out, s.about);
        let header = if s.repeated { format!("[[{path}]]") } else { format!("[{path}]") };
        // A table that may be absent must not appear by being described.
        let is_absent = is_absent || (s.default.is_none() && !s.required);
        *out += &format!("{}{header}\n", if is_absent { "#" } else { "" });
        tables(out, &path, &s.settings, is_absent);
    }
}

/// What it does; unit; limits; source of the default.
pub(super) fn explain(s: &Setting) -> String {
    let mut parts = Vec::new();
    match (s.required, s.default.is_none()) {
        (true, _) => parts.push("required".to_owned()),
        (false, true) => parts.push("absent by default".to_owned()),
        _ => {}
    }
    if !s.unit().is_empty() {
        parts.push(s.unit().to_owned());
    }
    if let Some(limits) = s.limits.filter(|l| *l != crate::settings::Limits::ANY) {
        parts.push(limits.to_string());
    }
    if !s.source.is_empty() {
        parts.push(format!("source: {}", s.source));
    }
    let mut text = s.about.to_owned();
    for (word, about) in s.choices {
        text += &format!(" \"{word}\": {}", about.trim());
    }
    if !parts.is_empty() {
        text += &format!(" ({})", parts.join("; "));
    }
    text
}

/// `text` as comment lines.
pub(super) fn comment(out: &mut String, text: &str) {
    let mut column = 0;
    for word in text.split_whitespace() {
        let length = word.chars().count() + 1;
        if column == 0 || column + length > COLUMNS {
            *out += if column == 0 { "#" } else { "\n#" };
            column = 1;
        }
        *out += " ";
        *out += word;
        column += length;
    }
    *out += "\n";
}

#[cfg(test)]
mod tests {
    use serde::de::{Deserialize, Deserializer, Visitor, value::Error};

    use super::*;
    use crate::coverage::CoverageSettings;
    use crate::failsafe::FailsafeSettings;
    use crate::http::HttpSettings;
    use crate::link::Signing;
    use crate::map::MapSettings;
    use crate::mission::*;
    use crate::training::*;
    use crate::upload::TlsSettings;

    /// Asks a type for the names that serde reads: of its fields when it is a struct, of its variants when it is an enum.
    struct Probe<'a>(&'a mut &'static [&'static str]);

    impl<'de> Deserializer<'de> for Probe<'_> {
        type Error = Error;

        fn deserialize_any<V: Visitor<'de>>(self, _: V) -> Result<V::Value, Error> {
            Err(serde::de::Error::custom("a leaf"))
        }

        fn deserialize_struct<V: Visitor<'de>>(
            self,
            _: &'static str,
            fields: &'static [&'static str],
            _: V,
        ) -> Result<V::Value, Error> {
            *self.0 = fields;
            Err(serde::de::Error::custom("seen"))
        }

        fn deserialize_enum<V: Visitor<'de>>(
            self,
            _: &'static str,
            variants: &'static [&'static str],
            _: V,
        ) -> Result<V::Value, Error> {
            *self.0 = variants;
            Err(serde::de::Error::custom("seen"))
        }

        serde::forward_to_deserialize_any! {
            bool i8 i16 i32 i64 u8 u16 u32 u64 f32 f64 char str string bytes byte_buf option unit unit_struct newtype_struct
            seq tuple tuple_struct map identifier ignored_any
        }
    }

    fn read_by_serde<T: for<'de> Deserialize<'de>>() -> Vec<&'static str> {
        let mut names: &'static [&'static str] = &[];
        let _ = T::deserialize(Probe(&mut names));
        names.to_vec()
    }

    fn described<T: Value>() -> Vec<&'static str> {
        T::settings().iter().map(|s| s.name).chain(T::choices().iter().map(|c| c.0)).collect()
    }

    #[test]
    fn a_line_that_is_just_full_ends_like_any_other() {
        let mut out = String::new();
        comment(&mut out, &format!("{} next", "x".repeat(COLUMNS - 2)));
        let lines: Vec<&str> = out.lines().collect();
        assert_eq!((lines.len(), lines[1]), (2, "# next"), "{out}");
    }

    #[test]
    fn every_name_that_serde_reads_is_described_and_no_other() {
        macro_rules! same {
            ($($type:ty),+) => {
                $(assert_eq!(read_by_serde::<$type>(), described::<$type>(), stringify!($type));)+
            };
        }
        same!(Mission, Geodetic, CameraSettings, MountSettings, MountAttitude, LinkSettings, Signing, KeyframeSettings);
        same!(MemorySettings, Preset, NetworkSettings, UploadSettings, TlsSettings, GroundSettings, InitSettings);
        same!(RefineSettings, TrainSettings, LossSettings, RateSettings, AdamSettings, DensitySettings, Strategy);
        same!(ShSettings, ResolutionSettings, ViewSettings, StopSettings, RegulariseSettings, SkipSettings);
        same!(FaultSettings, FailsafeSettings, CoverageSettings, HttpSettings, SurveySettings, Aircraft);
    }

    /// All tables of the reference, as the structs that would be read from it.
    #[test]
    fn every_default_of_the_reference_is_the_default() {
        let text = reference();
        let mut file: toml::Table = text.parse().unwrap_or_else(|e| panic!("{e}\n{text}"));
        let aircraft = file.remove("aircraft").expect("[[aircraft]]");
        for required in ["camera", "origin"] {
            file.remove(required).expect(required);
        }
        macro_rules! default {
            ($($name:ident: $type:ty),+) => {
                $(let table = file.remove(stringify!($name)).expect(stringify!($name));
                let read: $type = table.try_into().unwrap_or_else(|e| panic!("{}: {e}", stringify!($name)));
                assert_eq!(read, <$type>::default());)+
            };
        }
        default!(seed: u64, mount: MountSettings, link: LinkSettings, keyframes: KeyframeSettings, memory: MemorySettings);
        default!(network: NetworkSettings, upload: UploadSettings, ground: GroundSettings, init: InitSettings);
        default!(map: MapSettings, http: HttpSettings);
        default!(refine: RefineSettings, training: TrainSettings, faults: FaultSettings, failsafe: FailsafeSettings);
        default!(coverage: CoverageSettings);
        assert!(file.is_empty(), "compared with nothing: {file:?}");
        let given: toml::Table = "id = \"a\"\nlink = \"tcpin:1\"\ncamera = { folder = \"a\" }".parse().expect("TOML");
        let mut full = aircraft[0].as_table().expect("a table").clone();
        full.extend(given.clone());
        let [bare, full]: [Aircraft; 2] = [given, full].map(|t| t.try_into().expect("aircraft"));
        assert_eq!(bare, full);
        let given = "width = 1\nheight = 1\nfx = 1.0\nfy = 1.0\ncx = 1.0\ncy = 1.0";
        let bare: CameraSettings = toml::from_str(given).expect("camera");
        assert_eq!((bare.distortion, bare.exposure_delay_ms), ([0.0; 4], 0.0));
        assert!(text.contains("distortion = [0.0, 0.0, 0.0, 0.0]") && text.contains("exposure_delay_ms = 0.0"));
    }

    #[test]
    fn the_reference_says_unit_limits_source_and_words() {
        let text = reference().replace("\n# ", " ");
        assert!(text.contains("seconds; 0.1 to 3600; source: QGroundControl"), "{text}");
        assert!(text.contains("\"require\": We sign; only rightly signed"), "{text}");
        assert!(!text.contains("[`"), "a link of rustdoc in the reference");
    }
}

//! One definition per setting: its name, type, default, limits, unit, source and what it does. The struct, its `Default`,
//! its check and its lines of the reference (`dgtr init --reference`) are all made from it by `table!`, `record!` and `choice!`.

use std::path::PathBuf;

use serde::Serialize;
use serde::de::DeserializeOwned;

mod limits;

pub use limits::Limits;

/// A setting that cannot be worked with: which, what it is, what it must be.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{field} = {value}: must be {wanted}")]
pub struct SettingError {
    /// Path of the setting from the table that was checked, as in `rates.opacity`.
    pub field: String,
    /// Its value as TOML.
    pub value: String,
    /// What would be accepted.
    pub wanted: String,
}

impl SettingError {
    /// `field` is `value` and must be `wanted`.
    pub fn new<T: Serialize + ?Sized>(field: &str, value: &T, wanted: impl std::fmt::Display) -> Self {
        let value = as_toml(value).unwrap_or_else(|| "absent".to_owned());
        Self { field: field.to_owned(), value, wanted: wanted.to_string() }
    }

    /// This error as the table sees it that holds this one as `name`.
    pub fn at(mut self, name: &str) -> Self {
        let dot = if self.field.is_empty() || self.field.starts_with('[') { "" } else { "." };
        self.field = format!("{name}{dot}{}", self.field);
        self
    }
}

/// A value as it is written in a TOML file, on one line; None for an absent one.
pub(crate) fn as_toml<T: Serialize + ?Sized>(value: &T) -> Option<String> {
    let mut text = String::new();
    value.serialize(toml::ser::ValueSerializer::new(&mut text)).ok()?;
    // A text of several lines is written as one.
    Some(text.replace('\n', "\\n"))
}

/// One setting, or one table of settings, as the reference prints it.
#[derive(Clone, Debug)]
pub struct Setting {
    /// Key in the file.
    pub name: &'static str,
    /// What it does.
    pub about: &'static str,
    /// The default as TOML; None = absent.
    pub default: Option<String>,
    /// True when there is no default and the file must give it.
    pub required: bool,
    /// What it may be, when it is a number.
    pub limits: Option<Limits>,
    /// Its unit; empty when its name or its type says it.
    pub unit: &'static str,
    /// Where the default comes from; empty = chosen here.
    pub source: &'static str,
    /// The values there are with what they mean, when there are a few.
    pub choices: &'static [(&'static str, &'static str)],
    /// What lies below, when it is a table.
    pub settings: Vec<Setting>,
    /// True for a table that may be given several times.
    pub repeated: bool,
}

impl Setting {
    /// Unit by the end of the name, or as stated.
    pub fn unit(&self) -> &'static str {
        const ENDINGS: [(&str, &str); 11] = [
            ("_mib", "MiB"),
            ("_kib", "KiB"),
            ("_pct", "%"),
            ("_deg", "degrees"),
            ("_px", "pixels"),
            ("_ms", "milliseconds"),
            ("_s", "seconds"),
            ("_m", "metres"),
            ("seconds", "seconds"),
            ("_wh", "watt-hours"),
            ("watts", "watts"),
        ];
        let by_name = || ENDINGS.iter().find(|(ending, _)| self.name.ends_with(ending)).map_or("", |e| e.1);
        if self.unit.is_empty() { by_name() } else { self.unit }
    }
}

/// A type that settings have.
pub trait Value {
    /// Is every number of it inside `limits`, and everything else as it must be?
    ///
    /// # Errors
    /// The first setting that is not.
    fn check(&self, limits: &Limits) -> Result<(), SettingError> {
        let _ = limits;
        Ok(())
    }

    /// The values there are, with what they mean; none when there are many.
    fn choices() -> &'static [(&'static str, &'static str)] {
        &[]
    }

    /// What lies below, when it is a table.
    fn settings() -> Vec<Setting> {
        Vec::new()
    }

    /// True for what may be given several times.
    const REPEATED: bool = false;

    /// True for what is a number.
    const NUMBER: bool = false;
}

macro_rules! numbers {
    ($($type:ty => $limits:ident $hold:expr;)+) => {
        $(impl Value for $type {
            fn check(&self, $limits: &Limits) -> Result<(), SettingError> {
                if $hold(*self) { Ok(()) } else { Err(SettingError::new("", self, $limits)) }
            }

            const NUMBER: bool = true;
        })+
    };
}

numbers! {
    u8 => limits |v| limits.hold(f64::from(v));
    u32 => limits |v| limits.hold(f64::from(v));
    u64 => limits |v| limits.hold(v as f64);
    usize => limits |v| limits.hold(v as f64);
    f32 => limits |v| limits.single().hold(f64::from(v));
    f64 => limits |v| limits.hold(v);
}

impl Value for bool {}
impl Value for String {}
impl Value for PathBuf {}

impl<T: Value> Value for Option<T> {
    fn check(&self, limits: &Limits) -> Result<(), SettingError> {
        self.as_ref().map_or(Ok(()), |v| v.check(limits))
    }

    fn choices() -> &'static [(&'static str, &'static str)] {
        T::choices()
    }

    fn settings() -> Vec<Setting> {
        T::settings()
    }

    const NUMBER: bool = T::NUMBER;
}

fn check_each<T: Value>(values: &[T], limits: &Limits) -> Result<(), SettingError> {
    let bad = |(i, v): (usize, &T)| v.check(limits).map_err(|e| e.at(&format!("[{i}]")));
    values.iter().enumerate().try_for_each(bad)
}

impl<T: Value, const N: usize> Value for [T; N] {
    fn check(&self, limits: &Limits) -> Result<(), SettingError> {
        check_each(self, limits)
    }

    const NUMBER: bool = T::NUMBER;
}

impl<T: Value> Value for Vec<T> {
    fn check(&self, limits: &Limits) -> Result<(), SettingError> {
        check_each(self, limits)
    }

    fn settings() -> Vec<Setting> {
        T::settings()
    }

    const REPEATED: bool = true;
    const NUMBER: bool = T::NUMBER;
}

/// The first of the two that is there.
macro_rules! given {
    ($given:expr; $otherwise:expr) => {
        $given
    };
    (; $otherwise:expr) => {
        $otherwise
    };
}
pub(crate) use given;

/// Check and description of a struct, by its fields.
macro_rules! described {
    ($name:ident {
        $([$doc:expr] $field:ident: $type:ty $(= $default:expr)? $(, in $limits:expr)? $(, unit $unit:literal)? $(, from $source:literal)?;)+
    } $($also:path)?) => {
        impl $crate::settings::Value for $name {
            fn check(&self, _: &$crate::settings::Limits) -> Result<(), $crate::settings::SettingError> {
                use $crate::settings::{Value, given};
                $(Value::check(&self.$field, &given!($($limits)?; $crate::settings::Limits::ANY))
                    .map_err(|e| e.at(stringify!($field)))?;)+
                $($also(self)?;)?
                Ok(())
            }

            fn settings() -> Vec<$crate::settings::Setting> {
                use $crate::settings::{Setting, Value, given};
                vec![$(Setting {
                    name: stringify!($field),
                    about: $doc.trim_ascii(),
                    default: given!($($crate::settings::as_toml::<$type>(&$default))?; None),
                    required: given!($({ let _ = stringify!($default); false })?; true),
                    limits: <$type as Value>::NUMBER.then_some(given!($($limits)?; $crate::settings::Limits::ANY)),
                    unit: given!($($unit)?; ""),
                    source: given!($($source)?; ""),
                    choices: <$type as Value>::choices(),
                    settings: <$type as Value>::settings(),
                    repeated: <$type as Value>::REPEATED,
                }),+]
            }
        }
    };
}
pub(crate) use described;

/// A check that callers need no trait for.
macro_rules! checked {
    ($name:ident) => {
        impl $name {
            /// Checks every setting.
            ///
            /// # Errors
            /// The first that cannot be worked with: which, what it is, what it must be.
            pub fn check(&self) -> Result<(), $crate::settings::SettingError> {
                $crate::settings::Value::check(self, &$crate::settings::Limits::ANY)
            }
        }
    };
}
pub(crate) use checked;

/// A table of the mission file, every setting of which has a default:
/// `pub name: type = default, in limits, unit "unit", from "source";` with its documentation, of which only the default must be
/// given; `where path` names a further check of settings against each other.
macro_rules! table {
    ($(#[doc = $about:literal])+ $(#[derive($($derive:ident),+)])? $(#[serde($($serde:tt)+)])?
    pub struct $name:ident {
        $($(#[doc = $doc:literal])+
        pub $field:ident: $type:ty = $default:expr $(, in $limits:expr)? $(, unit $unit:literal)? $(, from $source:literal)?;)+
    } $(where $also:path)?) => {
        $(#[doc = $about])+
        #[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize $($(, $derive)+)?)]
        #[serde($($($serde)+,)? default, deny_unknown_fields)]
        pub struct $name {
            $($(#[doc = $doc])+ pub $field: $type,)+
        }

        impl Default for $name {
            fn default() -> Self {
                Self { $($field: $default),+ }
            }
        }

        $crate::settings::described!($name {
            $([concat!($($doc),+)] $field: $type = $default $(, in $limits)? $(, unit $unit)? $(, from $source)?;)+
        } $($also)?);
        $crate::settings::checked!($name);
    };
}
pub(crate) use table;

/// As [`table!`] for one that the file must give: a setting without default is required, one with a default also needs a
/// `#[serde(default)]` that says the same (a test compares them).
macro_rules! record {
    ($(#[doc = $about:literal])+ $(#[derive($($derive:ident),+)])?
    pub struct $name:ident {
        $($(#[doc = $doc:literal])+ $(#[serde($($serde:tt)+)])?
        pub $field:ident: $type:ty $(= $default:expr)? $(, in $limits:expr)? $(, unit $unit:literal)? $(, from $source:literal)?;)+
    } $(where $also:path)?) => {
        $(#[doc = $about])+
        #[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize $($(, $derive)+)?)]
        #[serde(deny_unknown_fields)]
        pub struct $name {
            $($(#[doc = $doc])+ $(#[serde($($serde)+)])? pub $field: $type,)+
        }

        $crate::settings::described!($name {
            $([concat!($($doc),+)] $field: $type $(= $default)? $(, in $limits)? $(, unit $unit)? $(, from $source)?;)+
        } $($also)?);
        $crate::settings::checked!($name);
    };
}
pub(crate) use record;

/// A setting that is one of a few words, the first of which is the default: `Variant = "word",`.
macro_rules! choice {
    ($(#[doc = $about:literal])+
    pub enum $name:ident {
        $(#[doc = $doc0:literal])+ $first:ident = $word0:literal,
        $($(#[doc = $doc:literal])+ $variant:ident = $word:literal,)+
    }) => {
        $(#[doc = $about])+
        #[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
        pub enum $name {
            $(#[doc = $doc0])+ #[default] #[serde(rename = $word0)] $first,
            $($(#[doc = $doc])+ #[serde(rename = $word)] $variant,)+
        }

        impl $name {
            /// Every word with what it stands for.
            pub const ALL: &'static [(&'static str, Self)] = &[($word0, Self::$first), $(($word, Self::$variant)),+];
        }

        impl $crate::settings::Value for $name {
            fn choices() -> &'static [(&'static str, &'static str)] {
                &[($word0, concat!($($doc0),+)), $(($word, concat!($($doc),+))),+]
            }
        }
    };
}
pub(crate) use choice;

/// Not TOML, an unknown key, or a wrong type.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("line {line}: {what}")]
pub struct SyntaxError {
    /// Line, from 1.
    pub line: usize,
    /// The reason on one line, with the nearest known word where an unknown one was given.
    pub what: String,
}

/// Settings from TOML text.
///
/// # Errors
/// The first line that is not TOML or not a setting of `T`.
pub fn parse<T: DeserializeOwned>(text: &str) -> Result<T, SyntaxError> {
    toml::from_str(text).map_err(|e: toml::de::Error| {
        let start = e.span().map_or(0, |s| s.start.min(text.len()));
        let line = text.as_bytes()[..start].iter().filter(|b| **b == b'\n').count() + 1;
        let message = e.message().replace('\n', " ");
        SyntaxError { line, what: nearest(&message).unwrap_or(message) }
    })
}

/// serde's "unknown field `a`, expected one of `b`, `c`" with the nearest of what was expected first.
fn nearest(message: &str) -> Option<String> {
    let kind = ["unknown field", "unknown variant"].into_iter().find(|k| message.starts_with(k))?;
    let mut quoted = message.split('`').skip(1).step_by(2);
    let given = quoted.next()?;
    let known: Vec<&str> = quoted.collect();
    let likeness = |word: &&&str| strsim::jaro_winkler(given, word);
    // The likeness from which on clap suggests a word, too.
    let best = known.iter().max_by(|a, b| likeness(a).total_cmp(&likeness(b))).filter(|w| likeness(w) > 0.7);
    let hint = best.map_or(String::new(), |w| format!("did you mean `{w}`? "));
    let what = if kind == "unknown field" { "unknown setting" } else { "unknown word" };
    Some(format!("{what} `{given}`; {hint}known here: {}", known.join(", ")))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_text_of_several_lines_is_refused_in_one() {
        let said = SettingError::new("id", "a\nb'c", "a name").to_string();
        assert!(said.contains("a\\nb") && said.lines().count() == 1, "{said}");
    }

    #[test]
    fn an_unknown_word_names_the_nearest_known_one() {
        let of = |m: &str| nearest(m).expect("known message");
        let told = of("unknown field `lnik`, expected one of `id`, `system_id`, `link`");
        assert_eq!(told, "unknown setting `lnik`; did you mean `link`? known here: id, system_id, link");
        assert!(!of("unknown field `zzz`, expected `a` or `b`").contains("mean"));
        assert_eq!(nearest("invalid type: string"), None);
    }
}

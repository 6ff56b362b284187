//! How large types are: no object that everything may change.
//!
//! Fields are those of a struct; methods are those of its own `impl` blocks, of whatever file; implementations of traits are the
//! traits' business. What a macro makes is not seen, nor is anything under `#[cfg(test)]`.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use syn::{Fields, ImplItem, Item, Type};

use super::{Module, attributes, crates, only_for_tests, root};

/// Most fields and methods of a type, and most files with `impl` blocks of it.
const MOST: Size = Size(15, 40, 4);

/// Fields, methods, files with `impl` blocks.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
struct Size(usize, usize, usize);

impl Size {
    fn fits(self, most: Self) -> bool {
        self.0 <= most.0 && self.1 <= most.1 && self.2 <= most.2
    }
}

/// Types that are still larger, and how large they may be. The list may only become shorter, and its numbers smaller.
const LARGER: [(&str, Size); 6] = [
    ("models: init::initialiser::Initialiser", Size(14, 32, 6)),
    ("models: refine::Refiner", Size(21, 90, 12)),
    ("models: refine::keyframe::KeyFrame", Size(23, 7, 1)),
    ("models: refine::report::RefineReport", Size(29, 1, 1)),
    ("models: refine::report::SharedEstimate", Size(18, 0, 0)),
    ("runtime/uplink: receive::ReceiveCounters", Size(16, 2, 1)),
];

/// A type as it is found.
#[derive(Default)]
struct Found {
    fields: usize,
    methods: usize,
    files: BTreeSet<PathBuf>,
}

#[derive(Default)]
struct Types {
    defined: BTreeMap<(Module, String), usize>,
    /// Where an `impl` stands, in which file, of what, with how many methods.
    implemented: Vec<(Module, PathBuf, String, usize)>,
}

impl Types {
    fn file(&mut self, module: Module, file: &Path, children: &Path) {
        let text = std::fs::read_to_string(file).unwrap_or_else(|e| panic!("{}: {e}", file.display()));
        let parsed = syn::parse_file(&text).unwrap_or_else(|e| panic!("{}: {e}", file.display()));
        self.items(module, &parsed.items, file, children);
    }

    fn items(&mut self, module: Module, items: &[Item], file: &Path, children: &Path) {
        for item in items.iter().filter(|i| !attributes(i).iter().any(only_for_tests)) {
            match item {
                Item::Mod(child) => {
                    let name = child.ident.to_string();
                    let (path, below) = ([module.clone(), vec![name.clone()]].concat(), children.join(&name));
                    match &child.content {
                        Some((_, inner)) => self.items(path, inner, file, &below),
                        None => self.file(path, &below.with_extension("rs"), &below),
                    }
                }
                Item::Struct(s) => {
                    let fields = if let Fields::Named(named) = &s.fields { named.named.len() } else { s.fields.len() };
                    self.defined.insert((module.clone(), s.ident.to_string()), fields);
                }
                Item::Enum(e) => _ = self.defined.insert((module.clone(), e.ident.to_string()), 0),
                Item::Impl(i) if i.trait_.is_none() => {
                    let Type::Path(path) = &*i.self_ty else { continue };
                    let Some(last) = path.path.segments.last() else { continue };
                    let methods = i.items.iter().filter(|i| matches!(i, ImplItem::Fn(_))).count();
                    self.implemented.push((module.clone(), file.to_owned(), last.ident.to_string(), methods));
                }
                _ => {}
            }
        }
    }

    /// Each type by its path in the crate. An `impl` belongs to the type of this name that is nearest to it.
    fn sizes(self) -> BTreeMap<String, Size> {
        let mut found: BTreeMap<&(Module, String), Found> =
            self.defined.iter().map(|(at, fields)| (at, Found { fields: *fields, ..Found::default() })).collect();
        for (module, file, name, methods) in &self.implemented {
            let common = |other: &Module| other.iter().zip(module).take_while(|(a, b)| a == b).count();
            let candidates = found.iter_mut().filter(|((_, n), _)| n == name);
            let Some((_, of)) = candidates.max_by_key(|((at, _), _)| common(at)) else { continue };
            of.methods += methods;
            of.files.insert(file.clone());
        }
        let sized = |(at, of): (&(Module, String), Found)| {
            let path = [at.0.clone(), vec![at.1.clone()]].concat().join("::");
            (path, Size(of.fields, of.methods, of.files.len()))
        };
        found.into_iter().map(sized).collect()
    }
}

#[test]
fn no_type_is_an_object_that_everything_may_change() {
    let mut larger = BTreeMap::new();
    for name in crates() {
        let src = root().join(&name).join("src");
        let mut types = Types::default();
        types.file(Module::new(), &src.join("lib.rs"), &src);
        let sizes = types.sizes();
        larger.extend(sizes.into_iter().filter(|(_, s)| !s.fits(MOST)).map(|(path, s)| (format!("{name}: {path}"), s)));
    }
    let known: BTreeMap<&str, Size> = LARGER.into_iter().collect();
    let beyond: Vec<_> =
        larger.iter().filter(|(path, size)| !known.get(path.as_str()).is_some_and(|most| size.fits(*most))).collect();
    assert!(beyond.is_empty(), "split these, or they stay within what the list says of them: {beyond:#?}");
    let gone: Vec<_> = known.keys().filter(|path| !larger.contains_key(**path)).collect();
    assert!(gone.is_empty(), "these leave the list: {gone:?}");
}

#[test]
fn methods_are_counted_over_all_files_of_a_type_and_tests_are_not() {
    let dir = tempfile::tempdir().expect("tempdir");
    std::fs::create_dir(dir.path().join("a")).expect("mkdir");
    let write = |name: &str, text: &str| std::fs::write(dir.path().join(name), text).expect("write");
    write("lib.rs", "mod a;\nmod b;\nimpl Clone for a::T {}");
    write("a.rs", "mod more;\npub struct T { x: u8, y: u8 }\nimpl T { fn f() {} }\n#[cfg(test)] impl T { fn t() {} }");
    write("a/more.rs", "use super::T;\nimpl T { fn g() {} fn h() {} }");
    write("b.rs", "enum T { A }\nimpl T { fn f() {} }");
    let mut types = Types::default();
    types.file(Module::new(), &dir.path().join("lib.rs"), dir.path());
    let sizes: Vec<_> = types.sizes().into_iter().collect();
    assert_eq!(sizes, [("a::T".to_owned(), Size(2, 3, 2)), ("b::T".to_owned(), Size(0, 1, 1))]);
}

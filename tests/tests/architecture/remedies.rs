//! What the system says of a file or a link never ends a line of ours: how to mend it follows.

use syn::visit::{self, Visit};
use syn::{Attribute, Fields, LitStr, Type};

use crate::{Crate, crates, root};

/// Texts of errors that end with the system's words.
#[derive(Default)]
struct Bare {
    texts: Vec<String>,
    /// Of so many that carry an error of the system.
    of: usize,
}

impl Bare {
    fn look_at(&mut self, attributes: &[Attribute], fields: &Fields) {
        let is_io = |of: &Type| {
            let Type::Path(path) = of else { return false };
            let names: Vec<_> = path.path.segments.iter().rev().take(2).map(|s| s.ident.to_string()).collect();
            names == ["Error", "io"]
        };
        if !fields.iter().any(|field| is_io(&field.ty)) {
            return;
        }
        for attribute in attributes.iter().filter(|a| a.path().is_ident("error")) {
            let text = attribute.parse_args_with(|input: syn::parse::ParseStream<'_>| {
                let text: LitStr = input.parse()?;
                // What is put into it.
                input.step(|at| {
                    let mut rest = *at;
                    while let Some((_, next)) = rest.token_tree() {
                        rest = next;
                    }
                    Ok(((), rest))
                })?;
                Ok(text.value())
            });
            // `transparent` shows what another type says.
            let Ok(text) = text else { continue };
            self.of += 1;
            if text.ends_with("{source}") {
                self.texts.push(text);
            }
        }
    }
}

impl<'a> Visit<'a> for Bare {
    fn visit_variant(&mut self, variant: &'a syn::Variant) {
        self.look_at(&variant.attrs, &variant.fields);
        visit::visit_variant(self, variant);
    }

    fn visit_item_struct(&mut self, of: &'a syn::ItemStruct) {
        self.look_at(&of.attrs, &of.fields);
        visit::visit_item_struct(self, of);
    }
}

#[test]
fn what_the_system_says_of_a_file_is_never_all_that_an_error_says() {
    let mut bare = Bare::default();
    for name in crates() {
        for file in Crate::read(&root().join(&name).join("src")).files.values() {
            let text = std::fs::read_to_string(file).expect("a source file");
            bare.visit_file(&syn::parse_file(&text).expect("Rust"));
        }
    }
    assert!(bare.of > 10, "{} errors carry one of the system", bare.of);
    // Whoever shows this one adds it.
    bare.texts.retain(|text| text != "{action} failed: {source}");
    assert_eq!(bare.texts, Vec::<String>::new(), "give `disk::told(source)` instead");
}

//! XMP properties by namespace and name, whether written as attributes or as elements, simple or as lists.

use std::collections::HashMap;

use roxmltree::Node;

use crate::xml;

/// Namespaces of the makers; a trailing slash more or less, or http instead of https, is the same one.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Maker {
    Dji,
    Parrot,
    Skydio,
    Pix4d,
    /// Google's tags of panoramas.
    Panorama,
}

impl Maker {
    fn of(namespace: &str) -> Option<Self> {
        let key = namespace.split("//").nth(1)?.trim_end_matches('/').to_lowercase();
        [
            ("www.dji.com/drone-dji", Self::Dji),
            ("www.parrot.com/drone-parrot", Self::Parrot),
            ("www.skydio.com/drone-skydio", Self::Skydio),
            ("pix4d.com/camera", Self::Pix4d),
            ("www.pix4d.com/camera", Self::Pix4d),
            ("ns.google.com/photos/1.0/panorama", Self::Panorama),
        ]
        .iter()
        .find_map(|(known, maker)| key.starts_with(known).then_some(*maker))
    }
}

/// The properties of one picture.
#[derive(Debug, Default)]
pub(super) struct Xmp(HashMap<(u8, String), String>);

impl Xmp {
    /// Parses a packet; what is no XML has no properties. Entities are not expanded beyond XML's own.
    pub(super) fn parse(packet: &str) -> Self {
        let mut all = Self::default();
        let packet = packet.trim_matches(['\0', '\u{feff}', ' ', '\n', '\r', '\t']);
        // Some writers repeat the packet header or leave zeros behind: the element itself is what counts.
        let element = packet.find("<x:xmpmeta").zip(packet.rfind("</x:xmpmeta>"));
        let packet = element.map_or(packet, |(from, to)| packet.get(from..to + "</x:xmpmeta>".len()).unwrap_or(packet));
        let Ok(document) = xml::parse(packet) else { return all };
        for node in document.descendants().filter(|n| n.tag_name().name() == "Description") {
            for a in node.attributes() {
                all.put(a.namespace(), a.name(), a.value());
            }
            for child in node.children().filter(Node::is_element) {
                let items: Vec<&str> = child
                    .descendants()
                    .filter(Node::is_text)
                    .filter_map(|n| n.text())
                    .map(str::trim)
                    .filter(|t| !t.is_empty())
                    .collect();
                all.put(child.tag_name().namespace(), child.tag_name().name(), &items.join(","));
            }
        }
        all
    }

    fn put(&mut self, namespace: Option<&str>, name: &str, value: &str) {
        if let Some(maker) = namespace.and_then(Maker::of) {
            self.0.entry((maker as u8, name.to_lowercase())).or_insert_with(|| value.trim().to_owned());
        }
    }

    /// A property; names differ in case between firmware versions.
    pub(super) fn text(&self, maker: Maker, name: &str) -> Option<&str> {
        self.0.get(&(maker as u8, name.to_lowercase())).map(String::as_str)
    }

    /// A finite number, as a decimal or a fraction.
    pub(super) fn number(&self, maker: Maker, name: &str) -> Option<f64> {
        number(self.text(maker, name)?)
    }

    /// Three finite numbers.
    pub(super) fn three(&self, maker: Maker, names: [&str; 3]) -> Option<[f64; 3]> {
        let [a, b, c] = names.map(|n| self.number(maker, n));
        Some([a?, b?, c?])
    }

    /// The finite numbers of a list.
    pub(super) fn list(&self, maker: Maker, name: &str) -> Option<Vec<f64>> {
        self.text(maker, name)?.split([',', ' ', ';']).filter(|t| !t.is_empty()).map(number).collect()
    }
}

pub(super) fn number(text: &str) -> Option<f64> {
    let text = text.trim();
    let value = match text.split_once('/') {
        Some((a, b)) => a.trim().parse::<f64>().ok()? / b.trim().parse::<f64>().ok()?,
        None => text.parse().ok()?,
    };
    value.is_finite().then_some(value)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn attributes_elements_lists_and_fractions_are_read_whatever_their_prefix() {
        let packet = r#"<?xpacket begin="" id="x"?><x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF
            xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#"><rdf:Description xmlns:d="http://www.dji.com/drone-dji/1.0/"
            xmlns:Camera="http://pix4d.com/camera/1.0" d:GimbalYawDegree="+45.00" d:SelfData=""><Camera:Yaw>1/2</Camera:Yaw>
            <Camera:PerspectiveDistortion><rdf:Seq><rdf:li>-0.1</rdf:li><rdf:li>0.05</rdf:li></rdf:Seq></Camera:PerspectiveDistortion>
            </rdf:Description></rdf:RDF></x:xmpmeta>  "#;
        let xmp = Xmp::parse(packet);
        assert_eq!(xmp.number(Maker::Dji, "GimbalYawDegree"), Some(45.0));
        assert_eq!(xmp.number(Maker::Pix4d, "Yaw"), Some(0.5));
        assert_eq!(xmp.list(Maker::Pix4d, "PerspectiveDistortion"), Some(vec![-0.1, 0.05]));
        assert_eq!((xmp.number(Maker::Dji, "SelfData"), xmp.number(Maker::Parrot, "Yaw")), (None, None));
    }

    #[test]
    fn elements_nested_by_the_thousand_have_no_properties_and_end_nobody() {
        let deep =
            |n: usize| format!("<x:xmpmeta xmlns:x='a'>{}{}</x:xmpmeta>", "<a b='/>'>".repeat(n), "</a>".repeat(n));
        assert!(xml::parse(&deep(63)).is_ok() && xml::parse(&deep(64)).is_err());
        assert!(xml::parse(&format!("<a>{}</a>", "<b/><!-- <c> --><d></d>".repeat(1000))).is_ok());
        // The default stack of a thread.
        let thread = std::thread::Builder::new().stack_size(2 << 20);
        let parsed = thread.spawn(move || Xmp::parse(&deep(9_000)).0.len()).expect("a thread").join();
        assert_eq!(parsed.expect("no overflow"), 0);
    }

    #[test]
    fn what_is_no_xml_or_grows_by_entities_has_no_properties() {
        let bomb = r#"<!DOCTYPE a [<!ENTITY x "aaaaaaaaaa"><!ENTITY y "&x;&x;&x;&x;&x;&x;">]><a>&y;</a>"#;
        for packet in ["", "<x:xmpmeta", "\0\0\0", bomb] {
            assert_eq!(Xmp::parse(packet).0.len(), 0, "{packet:?}");
        }
    }
}

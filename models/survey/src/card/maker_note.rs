//! DJI's maker note of the Phantom generation: one TIFF directory of floats, little-endian, without a header (ExifTool's
//! table `DJI::Main`).

/// Yaw, pitch and roll of the camera, degrees, −90 = straight down; `None` where there is no such note.
pub(super) fn dji_camera_angles(note: &[u8]) -> Option<[f64; 3]> {
    let entries = usize::from(u16::from_le_bytes(note.get(..2)?.try_into().ok()?));
    let float = |tag: u16| {
        note.get(2..2 + 12 * entries)?.chunks_exact(12).find_map(|e| {
            let number = |at: usize| u16::from_le_bytes([e[at], e[at + 1]]);
            // Type 11 is FLOAT, one of which stands in the entry itself.
            (number(0) == tag && number(2) == 11 && number(4) == 1)
                .then(|| f64::from(f32::from_le_bytes([e[8], e[9], e[10], e[11]])))
                .filter(|v| v.abs() <= 360.0)
        })
    };
    Some([float(0x0A)?, float(0x09)?, float(0x0B)?])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn camera_angles_are_found_and_garbage_is_not_believed() {
        let mut note = 3u16.to_le_bytes().to_vec();
        for (tag, value) in [(0x09u16, -75.1f32), (0x0A, 92.5), (0x0B, 0.0)] {
            note.extend([tag.to_le_bytes(), 11u16.to_le_bytes(), 1u16.to_le_bytes(), [0; 2]].concat());
            note.extend(value.to_le_bytes());
        }
        let angles = dji_camera_angles(&note);
        assert!(angles.is_some_and(|[y, p, r]| y == 92.5 && (p + 75.1).abs() < 1e-5 && r == 0.0), "{angles:?}");
        for len in 0..note.len() {
            assert_eq!(dji_camera_angles(&note[..len]), None, "{len}");
        }
        note[10..14].copy_from_slice(&f32::NAN.to_le_bytes());
        assert_eq!(dji_camera_angles(&note), None);
    }
}

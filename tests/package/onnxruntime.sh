# Sourced. onnxruntime MACHINE FOLDER: libonnxruntime.so and its licences for x86_64 or aarch64, out of its published Python package.
# Version and hashes are in runtime/onnxruntime.txt.
onnxruntime() {
    python3 -m pip download --quiet --disable-pip-version-check --no-deps --only-binary=:all: --implementation cp \
        --python-version 3.13 --abi cp313 --platform "manylinux_2_28_$1" --platform "manylinux_2_27_$1" \
        --dest "$2/wheel" --require-hashes -r runtime/onnxruntime.txt
    python3 - "$2" <<'PY'
import glob, gzip, sys, zipfile
made = sys.argv[1]
wheel = zipfile.ZipFile(glob.glob(made + "/wheel/onnxruntime-*.whl")[0])
library = next(n for n in wheel.namelist() if "/capi/libonnxruntime.so" in n)
with open(made + "/libonnxruntime.so", "wb") as out:
    out.write(wheel.read(library))
notices = b"\n\n".join(wheel.read("onnxruntime/" + n) for n in ("LICENSE", "ThirdPartyNotices.txt"))
with open(made + "/onnxruntime.txt.gz", "wb") as out:
    out.write(gzip.compress(notices, 9, mtime=0))
PY
}

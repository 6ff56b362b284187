// Directions and points of the world and of the camera.

vec3 to_camera(vec3 v) {
    return vec3(dot(frame.view_rows[0].xyz, v), dot(frame.view_rows[1].xyz, v), dot(frame.view_rows[2].xyz, v));
}

vec3 point_in_camera(vec3 p) {
    return to_camera(p) + vec3(frame.view_rows[0].w, frame.view_rows[1].w, frame.view_rows[2].w);
}

vec3 to_world(vec3 v) {
    return v.x * frame.view_rows[0].xyz + v.y * frame.view_rows[1].xyz + v.z * frame.view_rows[2].xyz;
}

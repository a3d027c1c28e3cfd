// What the player takes of three.js and Spark: bundled into ../spark.js.
export { Color, ColorManagement, Group, Matrix4, PerspectiveCamera, Scene, WebGLRenderer } from "three";
export { PackedSplats, SparkRenderer, SplatMesh } from "@sparkjsdev/spark";

// The parts of three.js and Spark that the player uses: bundled into ../spark.js.
export { Color, ColorManagement, Group, Matrix4, PerspectiveCamera, Scene, WebGLRenderer } from "three";
export { PackedSplats, SparkRenderer, SplatMesh } from "@sparkjsdev/spark";

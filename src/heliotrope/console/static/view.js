// One part of the page within the frame; console.js draws its contents.
export default {
  props: { kind: String, base: String },
  render() { return Vue.h("div", { class: `hx-view hx-${this.kind}` }); },
  mounted() {
    import(`${this.base}/console.js`).then((module) => { this.end = module.mount(this.kind, this.$el); });
  },
  unmounted() { this.end?.(); },
};

// SPDX-License-Identifier: Apache-2.0
// Browsers refuse workers on pages that are opened from a folder. Search then runs in a frame of the same interface.
window.IFrameWorker = class extends EventTarget {
  constructor(url) {
    super();
    this.onmessage = this.onerror = null;
    const frame = document.createElement("iframe");
    frame.hidden = true;
    document.body.appendChild(frame);
    this.frame = frame;
    const worker = frame.contentWindow;
    worker.postToPage = (data) => this.deliver(data);
    worker.document.open();
    worker.document.write(
      `<!doctype html><html><body><script>
        window.postMessage = window.postToPage;
        window.importScripts = (...urls) => urls.reduce((done, url) => done.then(() => new Promise((resolve) => {
          const script = document.createElement("script");
          script.src = url;
          script.addEventListener("load", resolve);
          document.body.appendChild(script);
        })), Promise.resolve());
      </` + `script><script src="${new URL(url, document.baseURI)}"></` + `script></body></html>`
    );
    worker.document.close();
    this.waiting = [];
    frame.addEventListener("load", () => {
      this.loaded = true;
      this.waiting.splice(0).forEach((data) => this.postMessage(data));
    });
  }
  deliver(data) {
    setTimeout(() => {
      const event = new MessageEvent("message", { data });
      this.dispatchEvent(event);
      if (this.onmessage) this.onmessage(event);
    });
  }
  postMessage(data) {
    if (!this.loaded) { this.waiting.push(data); return; }
    const worker = this.frame.contentWindow;
    worker.dispatchEvent(new worker.MessageEvent("message", { data }));
  }
  terminate() { this.frame.remove(); }
};
if (location.protocol === "file:") window.Worker = window.IFrameWorker;
